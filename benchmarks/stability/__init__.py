"""Sweeps to where numbers end."""
