"""D2-4DGS: dual-source depth guidance for any 4D Gaussian Splatting trainer."""

__version__ = "0.1.0"
