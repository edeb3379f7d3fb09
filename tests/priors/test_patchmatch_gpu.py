"""PatchMatch on the GPU: the same .cu source on the CPU (fibre shim) and, where there is one, on a GPU."""

import ctypes
import functools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import refuses
from splat_scenes import ShimLauncher

from benchmarks.stereo_rigs import Rig, textured_rig
from d2_plugin.compiler import load_library, nvrtc
from d2_plugin.priors.settings import StereoSettings
from d2_plugin.priors.stereo import patchmatch_cuda as gpu
from d2_plugin.priors.stereo import patchmatch_kernel
from d2_plugin.priors.stereo.geometric_depth import gray
from d2_plugin.priors.stereo.patchmatch import patchmatch
from d2_plugin.priors.stereo.patchmatch_cuda import PROGRAM, Call, flags_for
from d2_plugin.priors.stereo.pyramid import NO_MATCH
from d2_plugin.priors.stereo.source_views import choose_sources
from d2_plugin.recordings.recording import Camera

HERE = Path(__file__).parent
SETTINGS = StereoSettings()


class ShimDriver(ShimLauncher):
    def launch(self, kernel: str, sources: int, grid: tuple[int, int], threads: int, call: Call) -> None:
        self.launched.add(kernel)
        error = shim_library(sources).d2_shim_launch(kernel.encode(), grid[0], self.order, ctypes.byref(call))
        assert error is None, error.decode()


@functools.cache
def shim_library(sources: int) -> ctypes.CDLL:
    shim = HERE.parent / "rasterizer" / "cuda_shim.h"
    flags = (*(flag for flag in flags_for(sources) if flag.startswith("-D")), "-ffp-contract=off", "-O1")
    headers = (shim, PROGRAM.source, *PROGRAM.headers)
    library = load_library("patchmatch-shim", (HERE / "patchmatch_shim.cpp",), headers, flags)
    library.d2_shim_launch.restype = ctypes.c_char_p
    return library


@pytest.fixture(scope="module")
def rig() -> Rig:
    return textured_rig(3, width=64, height=37, seed=3)


def use_shim(monkeypatch: pytest.MonkeyPatch, order: int = 0) -> ShimDriver:
    driver = ShimDriver(order)
    monkeypatch.setattr(gpu, "why_not_usable", lambda: None)
    monkeypatch.setattr(gpu, "current_device", lambda: torch.device("cpu"))
    monkeypatch.setattr(gpu, "driver", lambda device: driver)
    return driver


@pytest.fixture(params=["shim", pytest.param("cuda", marks=pytest.mark.cuda)])
def backend(compiler: None, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where `patchmatch_device = 'cuda'` runs."""
    if request.param == "shim":
        use_shim(monkeypatch)
    elif not torch.cuda.is_available():
        pytest.skip("no CUDA device (torch.cuda.is_available() is False)")


def grays(rig: Rig) -> list[np.ndarray]:
    return [gray(image) for image in rig.images]


Maps = Sequence[tuple[np.ndarray, np.ndarray]]


def assert_same(found: Maps, expected: Maps) -> None:
    for (depth, cost), (other_depth, other_cost) in zip(found, expected, strict=True):
        np.testing.assert_array_equal(depth, other_depth)
        np.testing.assert_array_equal(cost, other_cost)


def on_both(images: list, cameras: list, depth_range: tuple, settings: StereoSettings = SETTINGS, wanted=None) -> Maps:
    """What `patchmatch` returns, the same bits on the GPU and on the CPU."""
    found, expected = (
        patchmatch(images, cameras, depth_range, replace(settings, patchmatch_device=device), wanted)
        for device in ("cuda", "cpu")
    )
    assert_same(found, expected)
    return found


@pytest.mark.parametrize("views", [2, 3])
@pytest.mark.parametrize("part", [False, True], ids=["all", "wanted"])
def test_the_gpu_returns_the_bits_of_the_cpu(backend: None, rig: Rig, views: int, part: bool) -> None:
    wanted = [np.zeros(image.shape, bool) for image in grays(rig)[:views]]
    for mask in wanted:
        mask[5:31, 10:40] = True
    found = on_both(grays(rig)[:views], rig.cameras[:views], rig.depth_range, wanted=wanted if part else None)
    assert part or (found[0][0] > 0).mean() > 0.9


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (7, 5), (13, 11)])
def test_images_smaller_than_a_window(backend: None, size: tuple[int, int]) -> None:
    K = np.array([[140.0, 0, size[0] / 2], [0, 140.0, size[1] / 2], [0, 0, 1]])
    moved = np.eye(4)
    moved[0, 3] = -0.7
    cameras = [Camera("a", *size, K, np.eye(4)), Camera("b", *size, K, moved)]
    random = np.random.default_rng(0)
    images = [random.integers(0, 255, size[::-1]).astype(np.uint8) for _ in cameras]
    for depth, cost in on_both(images, cameras, (3.0, 5.0)):
        assert depth.shape == cost.shape == size[::-1]
        assert np.isfinite(depth).all()
        assert ((cost >= 0) & (cost <= NO_MATCH)).all()


def test_many_sources_and_scattered_pixels(backend: None, rig: Rig) -> None:
    # Seven sources fill no vector; of the wanted pixels many stand alone, at the border too.
    cameras, images = [], [grays(rig)[number % 3] for number in range(10)]
    for number in range(10):
        camera, pose = rig.cameras[number % 3], rig.cameras[number % 3].T_camera_world.copy()
        pose[0, 3] += 0.02 * number
        cameras.append(replace(camera, name=str(number), T_camera_world=pose))
    settings = replace(SETTINGS, patchmatch_sources=7, max_angle=170.0, min_angle=1e-4)
    wanted = [np.random.default_rng(number).random(image.shape) < 0.1 for number, image in enumerate(images)]
    for mask in wanted[:3]:
        mask[0], mask[:, -1] = True, True
    for mask in wanted[3:]:
        mask[:] = False
    for depth_range in (rig.depth_range, (1e-3, 1e5)):  # the second one draws planes that leave most sources
        assert max(len(choose_sources(n, cameras, depth_range, settings)) for n in range(3)) == 7
        on_both(images, cameras, depth_range, settings, wanted)


def test_flat_pixels_among_textured_ones(backend: None, rig: Rig) -> None:
    images = [image.copy() for image in grays(rig)]
    for image in images:
        image[:, 20:45] = 128
    cost = on_both(images, rig.cameras, rig.depth_range)[0][1]
    assert (cost[15:22, 28:36] == NO_MATCH).all()
    assert (cost[:, :12] < NO_MATCH).any()


def test_no_result_depends_on_the_order_of_blocks_warps_and_lanes(compiler: None, rig: Rig, monkeypatch) -> None:
    results = []
    for order in (0, 1, 2):
        driver = use_shim(monkeypatch, order)
        results.append(patchmatch(grays(rig)[:2], rig.cameras[:2], rig.depth_range, SETTINGS))
        assert driver.launched == {f"d2_patchmatch_{name}" for name in ("begin", "update", "average")}
    for other in results[1:]:
        assert_same(other, results[0])


def test_a_missing_gpu_is_one_sentence(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    gpu.why_not_usable.cache_clear()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    asked = replace(SETTINGS, patchmatch_device="cuda")
    told = "patchmatch_device = 'cuda', but torch sees no CUDA device: set it to"
    refuses(told, patchmatch, grays(rig), rig.cameras, rig.depth_range, asked)
    gpu.why_not_usable.cache_clear()


@pytest.mark.parametrize("capability", [80, 90, 120])
def test_nvrtc_compiles_the_kernels_without_a_toolkit(capability: int, monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setenv("D2_CACHE", str(tmp_path))
    try:
        binary = nvrtc.build("patchmatch", PROGRAM, flags_for(4), capability)
    except nvrtc.NoCuda as error:
        pytest.skip(str(error))
    assert binary.code.startswith(b"\x7fELF")
    assert b"d2_patchmatch_update" in binary.code


def test_as_many_sources_as_there_may_be_are_refused_by_number_of_pixels(rig: Rig, monkeypatch) -> None:
    """Places in all sources together are 32-bit integers."""
    monkeypatch.setattr(patchmatch_kernel, "MOST_PIXELS", 1000)
    told = "pixels together, at most 1000 are possible: lower max_pixels"
    refuses(told, patchmatch, grays(rig), rig.cameras, rig.depth_range, replace(SETTINGS, patchmatch_device="cpu"))
