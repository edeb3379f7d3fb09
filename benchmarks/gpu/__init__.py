"""What a GPU has to show, and what can be said of the kernels without one."""
