"""Videos of cameras that did not start together: read with their own time stamps, brought onto one clock, imported."""
