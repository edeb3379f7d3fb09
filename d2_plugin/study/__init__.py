"""Metrics, evaluation, ablations and reports."""
