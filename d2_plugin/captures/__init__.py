"""Readers of recordings into one `Capture`."""
