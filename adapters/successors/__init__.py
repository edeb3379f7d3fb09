"""Adapters of codebases that grew out of another one, and what they changed on the way."""
