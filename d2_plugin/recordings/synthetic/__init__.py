"""Recordings that are rendered exactly, with true depth."""
