"""Drop-in modules for what the repositories build in CUDA, on this plugin's rasterizer, and for packages that are hard
to get. For people whose build fails and for machines without a GPU.

Importing them installs nothing: the launcher (`python -m d2_plugin.attach`) puts a module into place where the original
cannot be loaded, and says so. Which module stands in for what is in d2_plugin/attach/recipes.py and packages.py.

What differs from Inria's rasterizers: no cut at three standard deviations or at tile borders (a Gaussian reaches as far
as its alpha exceeds 1/255), and footprints use the focal length of the projection matrix where the field of view
contradicts it, which mends fudan's field of view of -1 (its issue 64).
"""
