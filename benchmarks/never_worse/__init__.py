"""D² against the backbone where the monocular maps are wrong."""
