"""One module for each command, with `add_arguments` and `run`, in rooms; imported when the command is called."""
