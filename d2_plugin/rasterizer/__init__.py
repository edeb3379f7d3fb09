"""Differentiable splatting with depth and alpha, and the survey of compositing weights."""
