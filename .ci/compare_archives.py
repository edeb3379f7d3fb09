"""`compare_archives.py FOLDER FOLDER`: the wheels in both folders hold the same files, byte for byte.

The first is made from the source archive, so a file that the archive lacks is found here.
"""

from __future__ import annotations

import hashlib
import sys
import zipfile
from pathlib import Path


def contents(folder: Path) -> dict[str, str]:
    """Name and SHA-256 of every file of the only wheel in a folder."""
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        return {name: hashlib.sha256(archive.read(name)).hexdigest() for name in archive.namelist()}


def main(first: Path, second: Path) -> str:
    """What differs, one line each; empty where nothing does."""
    one, other = contents(first), contents(second)
    lines = [f"only in {first.name}: {name}" for name in sorted(one.keys() - other.keys())]
    lines += [f"only in {second.name}: {name}" for name in sorted(other.keys() - one.keys())]
    return "\n".join(lines + [f"differs: {name}" for name in sorted(one) if other.get(name, one[name]) != one[name]])


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])) or 0)
