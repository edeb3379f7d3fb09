"""A prior on disk: opened, checked, looked up."""
