"""One run, from a capture to a held-out score."""
