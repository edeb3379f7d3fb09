"""NVRTC, its cache and the launcher: what happens to gpu.cu before it runs, without a GPU."""

import ctypes
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from refusals import refuses
from splat_scenes import Path as Where
from splat_scenes import prior_of, random_scene, shim_library, use_shim

from d2_plugin import D2Error
from d2_plugin.compiler import NoCompiler, driver, nvrtc
from d2_plugin.rasterizer import cuda, survey


@pytest.fixture
def compiler() -> Iterator[nvrtc.Nvrtc]:
    try:
        yield nvrtc.library()
    except nvrtc.NoCuda as error:
        pytest.skip(str(error))


@pytest.mark.parametrize(("capability", "channels"), [(80, 3), (90, 3), (120, 3), (90, 1), (90, 40)])
def test_nvrtc_compiles_the_kernels_without_a_toolkit(compiler, capability, channels, monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("D2_CACHE", str(tmp_path))
    code, architecture = cuda.binary_for(capability, channels)
    assert architecture == f"sm_{capability}"
    assert code.startswith(b"\x7fELF")
    for kernel in (b"d2_project", b"d2_render_front", b"d2_gather_survey"):
        assert kernel in code


def test_the_cache_serves_what_it_has_and_rebuilds_what_is_damaged(compiler, monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("D2_CACHE", str(tmp_path))
    first = cuda.binary_for(90, 3)
    (entry,) = tmp_path.iterdir()
    compiled = []
    compile_kernels = nvrtc.Nvrtc.compile
    monkeypatch.setattr(nvrtc.Nvrtc, "compile", lambda *a: compiled.append(1) or compile_kernels(*a))
    assert cuda.binary_for(90, 3) == first
    assert not compiled
    entry.write_bytes(entry.read_bytes()[:1000])
    assert cuda.binary_for(90, 3) == first
    assert compiled
    cuda.binary_for(90, 2)
    cuda.binary_for(80, 3)
    assert len(list(tmp_path.iterdir())) == 3


def test_a_cache_that_cannot_be_written_only_costs_time(compiler: nvrtc.Nvrtc, monkeypatch, tmp_path, caplog) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("D2_CACHE", str(tmp_path / "file" / "below"))
    assert cuda.binary_for(90, 3).code.startswith(b"\x7fELF")
    assert "cannot use the cache" in caplog.text


def test_a_gpu_newer_than_nvrtc_gets_ptx_and_an_older_one_a_sentence(compiler: nvrtc.Nvrtc) -> None:
    known = compiler.architectures()
    assert compiler.architecture_for(999) == f"compute_{known[-1]}"
    assert b".target" in compiler.compile(cuda.PROGRAM, "compute_80", cuda.flags_for(3))
    with pytest.raises(nvrtc.NoCuda, match=rf"the GPU is sm_35, but NVRTC \d+\.\d+ compiles for sm_{known[0]}"):
        compiler.architecture_for(35)


def test_nvrtcs_own_words_are_in_the_error(compiler: nvrtc.Nvrtc) -> None:
    with pytest.raises(D2Error, match="Frame differs between"):
        compiler.compile(cuda.PROGRAM, "sm_90", (*cuda.FLAGS, "-DD2_CHANNELS=3", "-DD2_FRAME_SIZE=1"))


def test_without_nvrtc_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nvrtc, "_files", lambda: iter(()))
    monkeypatch.setattr(ctypes, "CDLL", no_library)
    refuses(r"NVRTC.*not found: run `pip install 'd2-4dgs\[cuda\]'`", nvrtc.Nvrtc, error=nvrtc.NoCuda)


def test_without_a_driver_splatting_falls_back_with_one_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes, "CDLL", no_library)
    cuda.launcher.cache_clear()
    cuda.available.cache_clear()
    with pytest.warns(UserWarning, match=r"NVIDIA driver .* not found.* plain torch"):
        assert not cuda.available(torch.device("cuda", 7))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not cuda.available(torch.device("cuda", 7))
    cuda.available.cache_clear()


def no_library(*_: object, **__: object) -> None:
    raise OSError("no such library")


@pytest.fixture
def shim_driver(compiler: nvrtc.Nvrtc, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ctypes.CDLL:
    """The shim's CUDA driver in place of the real one, with stream 77 current."""
    try:
        shim = shim_library(3)
    except NoCompiler as error:
        pytest.skip(str(error))
    monkeypatch.setenv("D2_CACHE", str(tmp_path))
    monkeypatch.setattr(driver, "load_driver", lambda: shim)
    monkeypatch.setattr(torch.cuda, "init", lambda: None)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0))
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: SimpleNamespace(cuda_stream=77))
    return shim


def test_the_launcher_talks_to_the_driver(shim_driver: ctypes.CDLL, monkeypatch: pytest.MonkeyPatch) -> None:
    """Context, module, functions, frame and stream arrive; the kernels themselves run in the shim."""
    use_shim(monkeypatch, cuda.Launcher(torch.device("cuda", 0)))
    scene, results = random_scene(0, 100, 32, 32), []
    for dtype in (torch.float32, torch.float64):
        leaves = scene.on(Where(dtype)).requires_grad()
        render = leaves.render()
        results.append([*render[:3], *torch.autograd.grad(render.color.square().sum(), leaves[:4])])
    for found, expected in zip(*results):
        assert (found.double() - expected).norm() < 1e-3 * expected.norm()
    assert survey(scene.on(Where(torch.float32)).splats, scene.view, prior_of(scene.view)).hits.any()
    assert shim_driver.d2_shim_stream() == 77
    assert shim_driver.d2_shim_contexts() == 0


def test_a_driver_that_refuses_the_kernels_is_named(shim_driver: ctypes.CDLL, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "binary_for", lambda *_: nvrtc.Binary(b"no cubin", "sm_90"))
    with pytest.raises(nvrtc.NoCuda, match=r"refuses kernels for sm_90 .*NO_BINARY.*: update the NVIDIA driver"):
        cuda.Launcher(torch.device("cuda", 0))
    assert shim_driver.d2_shim_contexts() == 0


@pytest.mark.parametrize("grid", [(2**31, 1), (1, 65536)])
def test_a_grid_that_no_device_launches_is_one_sentence(shim_driver: ctypes.CDLL, grid: tuple[int, int]) -> None:
    launcher = cuda.Launcher(torch.device("cuda", 0))
    with pytest.raises(D2Error, match=rf"a grid of {grid[0]} x {grid[1]} blocks, at most 2147483647 x 65535"):
        launcher.launch("d2_project", grid[0], cuda.frame_of(*empty_scene()), rows=grid[1])
    assert shim_driver.d2_shim_contexts() == 0


def test_a_launch_of_nothing_never_reaches_the_driver(shim_driver: ctypes.CDLL) -> None:
    """Which refuses an empty grid, as the real one does."""
    cuda.Launcher(torch.device("cuda", 0)).launch("d2_project", 0, cuda.frame_of(*empty_scene()))


def empty_scene() -> tuple:
    means, covariances, opacities = torch.zeros(0, 3), torch.zeros(0, 6), torch.zeros(0)
    constants = [0.2, 0.3, 0.99, 1 / 255, 1e-4, 1.3, 0.0]
    return means, covariances, opacities, (torch.eye(4), torch.eye(3), 16, 16), constants, 0
