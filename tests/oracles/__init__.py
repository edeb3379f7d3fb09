"""NumPy twins of compiled kernels: what the kernels are tested against. Nothing that ships imports them."""
