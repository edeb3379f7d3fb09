"""Depth of all views of an instant from one network, as a source beside matching and monocular maps."""
