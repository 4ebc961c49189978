"""Compare the force of a log, a recording without EIT, with the channels that shall tell it."""
