"""Geometric depth from several cameras."""
