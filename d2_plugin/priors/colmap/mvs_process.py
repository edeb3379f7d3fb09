"""The process in which COLMAP's PatchMatch runs: `python -P mvs_process.py WORKSPACE`.

COLMAP answers a missing GPU, an empty depth range or a workspace it cannot read by aborting the whole process, so it
gets one of its own. This file is run by its path and imports nothing of the package: it starts without loading torch.
"""

from __future__ import annotations

import json
import sys
import zlib  # noqa: F401  before pycolmap, whose own copy of zlib would otherwise be bound and crash later calls
from pathlib import Path

OPTIONS = "options.json"
"""Name of the file in the workspace that holds fields of `pycolmap.PatchMatchOptions`."""


def main(workspace: Path) -> None:
    """Match all images that the workspace's patch-match.cfg names."""
    import pycolmap

    options = pycolmap.PatchMatchOptions()
    for name, value in json.loads((workspace / OPTIONS).read_text()).items():
        setattr(options, name, value)
    pycolmap.patch_match_stereo(workspace, options=options)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
