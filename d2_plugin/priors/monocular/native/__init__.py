"""The parts of alignment and local correction that are compiled, and orders by what NumPy has compiled."""
