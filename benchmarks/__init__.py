"""What only developers measure, from a checkout: `python -m benchmarks PART ...`. No wheel installs it."""
