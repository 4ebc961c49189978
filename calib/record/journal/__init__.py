"""The journal of a recording: the file that survives a crash, its records, and their conversion to a session."""
