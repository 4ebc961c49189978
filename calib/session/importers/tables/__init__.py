"""Tables of numbers in files: columns, clocks, and the conversion to a session."""
