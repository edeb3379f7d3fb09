"""Monocular depth: predicted, aligned to geometric depth, corrected."""
