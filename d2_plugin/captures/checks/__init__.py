"""What a capture is checked for before work begins: calibration, memory, exposure."""
