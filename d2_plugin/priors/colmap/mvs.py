"""COLMAP's PatchMatch as a matcher of geometric depth: the paper's own choice where there is a CUDA device.

For each timestamp a workspace is written whose cameras are known (images, sparse model without points, explicit
sources per view), COLMAP matches it in a process of its own, and its depth maps are checked before anyone believes
them: without sources or memory COLMAP returns success and no output.

COLMAP writes no cost map. What its own photometric and geometric filter leaves has a cost of 0, and the filter that
all matchers share does the rest.
"""

from __future__ import annotations

import logging
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from d2_plugin.errors import D2Error, MissingExtra
from d2_plugin.extras import import_pycolmap
from d2_plugin.priors.colmap.mvs_process import OPTIONS
from d2_plugin.priors.colmap.workspace import read_dense_array
from d2_plugin.priors.extras import opencv
from d2_plugin.priors.geometry import check_depth_range, check_views, index_intrinsics
from d2_plugin.priors.stereo.pyramid import NO_MATCH
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.priors.stereo.source_views import choose_sources
from d2_plugin.reading import json_text
from d2_plugin.recordings.cameras.rotations import quaternion_of_rotation
from d2_plugin.recordings.recording import Camera

CHILD = Path(__file__).with_name("mvs_process.py")
CACHE_GIGABYTES = 8.0
"""Memory that COLMAP may keep images and maps in; four views of ten megapixels take less than one."""

Runner = Callable[[Path, float], None]
"""(workspace, seconds after which to give up): leaves depth maps in the workspace, or raises `D2Error`."""

logger = logging.getLogger(__name__)


def why_not_usable() -> str:
    """Why COLMAP's PatchMatch cannot run here, as the middle of a sentence; empty where it can.

    `pycolmap.has_cuda` alone only tells how pycolmap was compiled: it is True without any device.
    """
    try:
        pycolmap = import_pycolmap("COLMAP's PatchMatch", "stereo")
    except MissingExtra:
        return "pycolmap is not installed"
    if not pycolmap.has_cuda:
        return "the installed pycolmap was built without CUDA"
    return "" if _has_cuda_device() else "there is no CUDA device"


def _has_cuda_device() -> bool:
    import torch

    if torch.cuda.is_available():
        return True
    query = shutil.which("nvidia-smi")  # torch may be a CPU build beside a CUDA build of COLMAP
    if query is None:
        return False
    listed = subprocess.run([query, "--list-gpus"], capture_output=True, text=True, check=False)
    return listed.returncode == 0 and "GPU" in listed.stdout


def colmap_patch_match(
    grays: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    depth_range: tuple[float, float],
    settings: StereoSettings,
    wanted: Sequence[np.ndarray] | None = None,
    *,
    run: Runner | None = None,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Depth and matching cost of every view from the others, as every matcher returns them.

    Args:
        grays: uint8 [H, W] per camera, synchronized.
        cameras: at least two, in the same order.
        depth_range: near and far in world units. COLMAP draws its first depths uniformly between them (in depth, so a
            far end that is far too large wastes them) and may leave the range; what leaves it is dropped.
        settings: the `colmap_*` fields, `patchmatch_sources`, `min_angle` and `max_angle`.
        wanted: not used, since COLMAP matches whole images.
        run: what runs COLMAP on a workspace; a process of its own where None.

    Returns:
        Per camera: planar depth float32 [H, W], 0 where COLMAP's own filter left none, and the cost float32 [H, W]: 0
        where there is a depth, 2 elsewhere. A view that no other one meets at an angle has no depth anywhere.

    Raises:
        D2Error: COLMAP cannot run here, ended with an error, or left a map that is missing, of another size, or not
            finite; fewer than two views; an inverted depth range.
    """
    check_views(grays, cameras)
    near, far = check_depth_range(depth_range)
    if run is None and (reason := why_not_usable()):
        raise D2Error(
            f"matcher = colmap needs pycolmap with CUDA and a CUDA device, but {reason}: install pycolmap-cuda12 in "
            "place of pycolmap on a machine with a GPU, or set matcher = patchmatch"
        )
    sources = mutual_sources([choose_sources(i, cameras, (near, far), settings) for i in range(len(cameras))])
    if not any(sources):
        return [_with_cost(np.zeros((camera.height, camera.width), np.float32)) for camera in cameras]
    with tempfile.TemporaryDirectory(prefix="d2_colmap_") as folder:
        workspace = Path(folder)
        write_workspace(workspace, grays, cameras, sources, patch_match_options((near, far), settings))
        (run or run_patch_match)(workspace, 60 * settings.colmap_minutes)
        kind = "geometric" if settings.colmap_geometric else "photometric"
        left = workspace / "stereo" / "depth_maps"
        maps = [
            _checked_map(left / f"{_image(index)}.{kind}.bin", camera)
            if sources[index]  # COLMAP was asked for no other
            else np.zeros((camera.height, camera.width), np.float32)
            for index, camera in enumerate(cameras)
        ]
    maps = [np.where((depth >= near) & (depth <= far), depth, np.float32(0)) for depth in maps]
    if not any(depth.any() for depth in maps):
        logger.warning("COLMAP found no depth in any view: no texture, a wrong depth range, or a GPU it is too old for")
    return [_with_cost(depth) for depth in maps]


def mutual_sources(sources: Sequence[Sequence[int]]) -> list[list[int]]:
    """Without views that have no sources of their own: COLMAP would look for their depth maps and abort."""
    kept = [list(others) for others in sources]
    while any(not kept[other] for others in kept for other in others):
        kept = [[other for other in others if kept[other]] for others in kept]
    return kept


def _with_cost(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return depth.astype(np.float32), np.where(depth > 0, 0, NO_MATCH).astype(np.float32)


def patch_match_options(depth_range: tuple[float, float], settings: StereoSettings) -> dict[str, object]:
    """Fields of `pycolmap.PatchMatchOptions` that differ from COLMAP's defaults.

    Its smallest angle of 3 degrees would drop everything deeper than 19 baselines.
    """
    return {
        "depth_min": depth_range[0],
        "depth_max": depth_range[1],
        "geom_consistency": settings.colmap_geometric,
        "filter": True,
        "filter_min_triangulation_angle": settings.min_angle,
        "cache_size": CACHE_GIGABYTES,
    }


def write_workspace(
    folder: Path,
    grays: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    sources: Sequence[Sequence[int]],
    options: dict[str, object],
) -> None:
    """Write what COLMAP's PatchMatch reads: images/, sparse/ (without points), stereo/patch-match.cfg, options.json.

    Images are named by position (`0000.png`), so that no name of a camera can be one that COLMAP's text files or the
    file system would not take. A view without sources is not listed: COLMAP would find none in a model without points.
    """
    cv2 = opencv("COLMAP's PatchMatch")
    for name in ("images", "sparse", "stereo/depth_maps", "stereo/normal_maps", "stereo/consistency_graphs"):
        (folder / name).mkdir(parents=True)
    for index, gray in enumerate(grays):
        if not cv2.imwrite(str(folder / "images" / _image(index)), gray):
            raise D2Error(f"an image could not be written to {folder}: make room for temporary files")
    write_model(folder / "sparse", cameras)
    listed = {_image(index): ", ".join(map(_image, others)) for index, others in enumerate(sources) if others}
    problems = "".join(f"{reference}\n{names}\n" for reference, names in listed.items())
    (folder / "stereo" / "patch-match.cfg").write_text(problems)
    (folder / OPTIONS).write_text(json_text(options, OPTIONS, indent=1))


def write_model(folder: Path, cameras: Sequence[Camera]) -> None:
    """COLMAP's text model of known cameras without points.

    COLMAP's PatchMatch addresses pixels by integers and uses K as it stands, so the principal point goes in array
    indices: with the half pixel of COLMAP's own convention depth is off by up to .2 %.
    """
    lenses, images = [], []
    for index, camera in enumerate(cameras):
        K = index_intrinsics(camera)
        numbers = " ".join(repr(float(value)) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        lenses.append(f"{index + 1} PINHOLE {camera.width} {camera.height} {numbers}\n")
        pose = (*quaternion_of_rotation(camera.T_camera_world[:3, :3]), *camera.T_camera_world[:3, 3])
        images.append(f"{index + 1} {' '.join(repr(float(v)) for v in pose)} {index + 1} {_image(index)}\n\n")
    (folder / "cameras.txt").write_text("".join(lenses))
    (folder / "images.txt").write_text("".join(images))
    (folder / "points3D.txt").write_text("")


def run_patch_match(workspace: Path, seconds: float, command: Sequence[str] | None = None) -> None:
    """Run COLMAP on a workspace in a process of its own: where COLMAP aborts its process, ours goes on.

    Args:
        workspace: as `write_workspace` leaves it.
        seconds: after which the process is ended.
        command: what to start with the workspace as last argument; the child of this package where None.

    Raises:
        D2Error: it ended with an error or a signal, which is quoted, or took too long.
    """
    # -P: the folder of the script has modules of its own that must not stand in for others.
    command = command or [sys.executable, "-P", str(CHILD)]
    try:
        ended = subprocess.run(
            [*command, str(workspace)], capture_output=True, text=True, errors="replace", timeout=seconds, check=False
        )
    except subprocess.TimeoutExpired:
        raise D2Error(
            f"COLMAP's PatchMatch took more than {seconds / 60:g} minutes for one timestamp and was ended: raise "
            "colmap_minutes, or lower max_pixels"
        ) from None
    if ended.returncode:
        raise D2Error(
            f"COLMAP's PatchMatch ended with {_ending(ended.returncode)} ({_last_words(ended.stderr)}): correct what "
            "it says, or set matcher = patchmatch"
        )


def _ending(code: int) -> str:
    if code > 0:
        return f"exit code {code}"
    try:
        return f"signal {signal.Signals(-code).name}"
    except ValueError:
        return f"signal {-code}"


def _last_words(text: str) -> str:
    """The last line that says what went wrong; glog prints a stack trace (`@ 0x...`) after it."""
    lines = [line.strip() for line in text.splitlines()]
    reasons = [line for line in lines if line and not line.startswith(("@", "***", "terminate called"))]
    return reasons[-1][:300] if reasons else "without a word"


def _checked_map(path: Path, camera: Camera) -> np.ndarray:
    if not path.is_file():
        raise D2Error(
            f"COLMAP's PatchMatch returned without an error but left no {path.name} for camera {camera.name}: it had "
            "no sources or no memory for that view; lower max_pixels, or set matcher = patchmatch"
        )
    depth = read_dense_array(path)
    if depth.shape != (camera.height, camera.width):
        raise D2Error(
            f"COLMAP's depth map of camera {camera.name} is {depth.shape[::-1]} pixels but its image is "
            f"{(camera.width, camera.height)}: let COLMAP keep the size of the images"
        )
    if not np.isfinite(depth).all():
        raise D2Error(
            f"COLMAP's depth map of camera {camera.name} has {np.count_nonzero(~np.isfinite(depth))} values that are "
            "not finite: update pycolmap and the GPU's driver, or set matcher = patchmatch"
        )
    return depth


def _image(index: int) -> str:
    return f"{index:04d}.png"
