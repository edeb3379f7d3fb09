"""Drop-in modules for what the Inria family of repositories builds in CUDA, on this plugin's rasterizer.

For people whose build fails and for machines without a GPU. Nothing here is installed by importing it: the launcher
(`python -m d2_plugin.attach`) puts a module into place only where the original cannot be imported, and says so.

    threedgs       diff_gaussian_rasterization of graphdeco-inria/gaussian-splatting       -> color, radii
    depth          the depth variants (hustvl/4DGaussians, ingra14m/Deformable-3D-Gaussians) -> color, radii, depth
    fourd          fudan-zvg/4d-gaussian-splatting, 4C4D              -> color, radii, depth, alpha, flow, covariances
    nearest        simple_knn._C.distCUDA2
    similarity     fused_ssim

The first three share `inria.py`. What differs from the originals: no cut at three standard deviations or at tile
borders (a Gaussian reaches as far as its alpha exceeds 1/255), and footprints use the focal length of the projection
matrix where the field of view contradicts it, which mends fudan's field of view of -1 (its issue 64).
"""
