"""Held-out quality against the time of training: backbone, rivals and D² side by side."""
