"""What users would pick instead of D², as hooks on the same backbone, points, steps and depth inputs."""
