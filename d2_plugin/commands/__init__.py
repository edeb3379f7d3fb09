"""The `d2` command: `cli.py` finds a command by its name, and each has a module of its own beside it."""
