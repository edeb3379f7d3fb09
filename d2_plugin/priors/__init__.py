"""Depth priors: monocular and geometric depth, aligned, verified, fused and stored."""
