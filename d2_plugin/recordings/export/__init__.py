"""Recordings written in the layouts of other repositories."""
