"""The compiled parts of alignment and local correction, each with the numbers of the NumPy code."""
