"""PatchMatch on a CUDA device, through NVRTC."""
