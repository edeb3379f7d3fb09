"""One run, from a recording to a held-out score."""
