"""The commands that compare: ablations, benchmarks, stability, and their report."""
