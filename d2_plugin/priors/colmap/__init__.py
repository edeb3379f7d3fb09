"""What COLMAP does for the priors: sparse points, its PatchMatch, its workspaces."""
