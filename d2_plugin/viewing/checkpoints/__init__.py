"""What `d2 render` and `d2 view` open: our runs, and what other trainers save as far as their adapters can read it.

| file | from | shown as |
|---|---|---|
| chkpnt*.pth with 19 or 21 entries | fudan-zvg/4d-gaussian-splatting, 4C4D | 4D Gaussians, by the adapter `fudan` |
| chkpnt*.pth with 12 or 14 entries | 3D Gaussian Splatting, and theirs without time | one instant |
| chkpnt_fine_*.pth; a point cloud with deformation.pth beside it | 4DGaussians | planes and decoder, see `networks` |
| a point cloud with deform/iteration_N/deform.pth | Deformable-3D-Gaussians | its network, see `networks` |
| ckpt_*.pt with "splats" | gsplat's simple_trainer | one instant |
| *.ply with scale_t | 4C4D; without cosines in time of its colours | 4D Gaussians |
| *.ply with trbf_center | SpacetimeGaussians; of the full model without its decoder | moving |
| *.ply | 3D Gaussian Splatting and all that write its format | one instant |

Nothing of their code is run or imported, and files are read as tensors and plain values only.
"""

from d2_plugin.viewing.checkpoints.files import read_ply
from d2_plugin.viewing.checkpoints.opening import is_output_folder, open_viewed

__all__ = ["is_output_folder", "open_viewed", "read_ply"]
