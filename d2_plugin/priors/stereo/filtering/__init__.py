"""The filter of geometric depth: its tests, and how precise what survives is."""
