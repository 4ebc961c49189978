"""Compare the presses with one another, with the places and targets of the table, and with the pads and the force."""
