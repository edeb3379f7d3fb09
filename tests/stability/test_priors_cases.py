"""COLMAP where it ends processes, numbered as in the list of cases that broke other codebases (cases 42 and 44).

Cases 43 and 45 are in test_align_stability.py, the other matchers of case 44 in test_stereo_stability.py.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from d2_plugin.errors import D2Error
from d2_plugin.priors.colmap.mvs import colmap_patch_match, run_patch_match, why_not_usable
from d2_plugin.priors.settings import StereoSettings
from d2_plugin.priors.stereo.geometric_depth import geometric_depth
from d2_plugin.recordings.recording import Camera
from d2_plugin.recordings.synthetic.room import arc_cameras

pytest.importorskip("cv2")

COLMAP = StereoSettings(matcher="colmap")


@pytest.fixture
def views() -> tuple[list[np.ndarray], list[Camera]]:
    cameras = list(arc_cameras(2, 0, 64, 48, 10.0).values())
    noise = np.random.default_rng(0)
    return [noise.integers(0, 255, (48, 64, 3), dtype=np.uint8) for _ in cameras], cameras


@pytest.mark.parametrize("order", ["torch, zlib, colmap", "colmap, torch, zlib", "zlib, colmap, torch"])
def test_case_42_compression_survives_pycolmap_whatever_is_imported_first(order: str) -> None:
    pytest.importorskip("pycolmap")
    imports = {
        "torch": "import torch",
        "zlib": "import zlib",
        "colmap": "from d2_plugin.extras import import_pycolmap; import_pycolmap('a test', 'stereo')",
    }
    code = "\n".join([*(imports[name] for name in order.split(", ")), "zlib.compress(bytes(10**5)); print('alive')"])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout.strip()) == (0, "alive"), done.stderr


def test_case_42_without_a_gpu_colmap_is_refused_in_a_sentence(views: tuple) -> None:
    if not why_not_usable():
        pytest.skip("COLMAP has a GPU here and would not refuse")
    images, cameras = views
    with pytest.raises(D2Error, match="needs pycolmap with CUDA and a CUDA device, but"):
        geometric_depth(images, cameras, (1.0, 9.0), COLMAP)


@pytest.mark.parametrize("name", ["SIGABRT", "SIGSEGV", "SIGKILL"])
def test_case_42_a_child_that_dies_leaves_the_parent_alive_with_a_clear_message(tmp_path: Path, name: str) -> None:
    code = f"import os, signal; os.kill(os.getpid(), signal.{name})"
    with pytest.raises(D2Error, match=f"ended with signal {name}"):
        run_patch_match(tmp_path, 60, [sys.executable, "-c", code])


def test_case_44_two_cameras_at_one_place_have_no_depth_and_colmap_is_not_even_asked(views: tuple) -> None:
    def run(workspace: Path, seconds: float) -> None:
        raise AssertionError("there is nothing to match")

    images, cameras = views
    same = [cameras[0], replace(cameras[0], name="again")]
    grays = [image.mean(-1).astype(np.uint8) for image in images]
    raw = colmap_patch_match(grays, same, (1.0, 9.0), COLMAP, run=run)
    assert not any(depth.any() for depth, _ in raw)
