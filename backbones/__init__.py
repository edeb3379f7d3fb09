"""Self-contained 4D Gaussian trainers in the style of the codebases that users have."""
