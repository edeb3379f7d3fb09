"""Error against run time of each part."""
