"""What a recording is checked for before work begins: calibration, memory, exposure."""
