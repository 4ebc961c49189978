"""What is known of the readings: their noise, which of them are missing, and numbers of unit noise."""
