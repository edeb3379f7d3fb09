"""A trained run as files that other programs open, and as one web page that plays it."""
