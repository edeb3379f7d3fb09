"""The `d2` command."""
