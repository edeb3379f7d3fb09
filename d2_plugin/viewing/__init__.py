"""What a person looks at: camera paths, video, live viewer, export of Gaussians, single-file web player."""
