"""What a person looks at: camera paths, pictures and videos, the live viewer, and exports for other programs."""
