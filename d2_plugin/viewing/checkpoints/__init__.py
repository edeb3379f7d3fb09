"""What `d2 render` and `d2 view` open: our runs, and what other trainers save as far as their adapters can read it.

docs/see.md lists the files. No code of the trainers is run or imported: files are read as tensors and plain values.
"""

from d2_plugin.viewing.checkpoints.files import read_ply
from d2_plugin.viewing.checkpoints.opening import is_output_folder, open_viewed

__all__ = ["is_output_folder", "open_viewed", "read_ply"]
