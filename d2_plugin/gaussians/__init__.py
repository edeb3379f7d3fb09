"""Mathematics of 4D Gaussians that backbones, adapters and stand-ins share."""
