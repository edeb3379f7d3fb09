"""What importing a package of the extras must not do to the process."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest


def test_a_process_with_pycolmap_ends_silently_at_sigterm() -> None:
    """COLMAP's logging library answers SIGTERM with a stack trace of C++ and an abort."""
    pytest.importorskip("pycolmap")
    first = "from d2_plugin.extras import import_pycolmap; import_pycolmap('a test', 'stereo')"
    code = f"{first}; import os, signal; os.kill(os.getpid(), signal.SIGTERM)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGTERM, "", "")
