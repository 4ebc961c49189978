"""One module for each command, with `add_arguments` and `run`; imported when the command is called."""
