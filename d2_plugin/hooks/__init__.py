"""The four hooks: prior, densify, prune, depth loss."""
