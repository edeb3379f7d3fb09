"""Time, memory and error of one rasterizer on one scene."""

import importlib.util
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks.memory import in_fresh_process, peak_resident
from benchmarks.raster_scenes import Scene, load_scene
from d2_plugin.rasterizer import DepthPrior, RasterSettings, Render, Splats, rasterize, reference, survey

SETTINGS = RasterSettings()
THRESHOLD_DEVIATION = 1e-5
"""Color or alpha that deviates more than this from float64 in a pixel does so because of a threshold."""

REFERENCE_LIMIT = 12_000
"""Most Gaussians for which the torch path is timed as a peer; with more of them it takes seconds per call."""


class Case(NamedTuple):
    """A scene at an image size."""

    scene: str
    width: int
    height: int
    garden: Path | None

    def load(self) -> Scene:
        """The Gaussians and the camera, float32 on the CPU."""
        return load_scene(self.scene, self.width, self.height, self.garden)


RenderScene = Callable[[Scene], Render]


def _d2(scene: Scene) -> Render:
    return rasterize(scene.splats(), scene.colors, scene.view, SETTINGS)


def _reference(scene: Scene) -> Render:
    return reference.rasterize(scene.splats(), scene.colors, scene.view, SETTINGS)


def _gsplat(scene: Scene) -> Render:
    """gsplat from covariances, with the same constants; its tiles cut at 3 sigma, so its error is not only rounding."""
    import gsplat

    view, device = scene.view, scene.colors.device
    full = scene.covariances[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    image, alpha, _ = gsplat.rasterization(
        *(scene.means, None, None, scene.opacities, scene.colors),
        *(view.T_camera_world.to(device)[None], view.K.to(device)[None], view.width, view.height),
        near_plane=SETTINGS.near,
        eps2d=SETTINGS.blur,
        render_mode="RGB+D",
        covars=full,
    )
    return Render(image[0, ..., :-1], image[0, ..., -1], alpha[0, ..., 0])


def implementations(device: torch.device, gaussians: int) -> dict[str, RenderScene]:
    """What is compared: this package; on the CPU the torch path up to `REFERENCE_LIMIT`, on a GPU gsplat."""
    found: dict[str, RenderScene] = {"d2": _d2}
    if device.type == "cpu" and gaussians <= REFERENCE_LIMIT:
        found["torch reference"] = _reference
    if device.type == "cuda" and importlib.util.find_spec("gsplat"):
        found["gsplat"] = _gsplat
    return found


def upstream(scene: Scene) -> list[Tensor]:
    """Fixed random gradients of color, depth sum and alpha."""
    g, size = torch.Generator().manual_seed(0), (scene.view.height, scene.view.width)
    return [torch.randn(shape, generator=g).to(scene.means) for shape in ((*size, 3), size, size)]


def prior_of(scene: Scene, device: torch.device) -> DepthPrior:
    """A depth prior with three fifths of its pixels verified, at random."""
    g = torch.Generator().manual_seed(0)
    size = (scene.view.height, scene.view.width)
    labels = torch.where(torch.rand(size, generator=g) < 0.6, 2, 1).to(torch.uint8)
    return DepthPrior((2 + 8 * torch.rand(size, generator=g)).to(device), labels.to(device))


def passes_of(render: RenderScene, scene: Scene, device: torch.device) -> dict[str, Callable[[], object]]:
    """What is timed: forward, forward and backward (gradients of everything for all three outputs), survey."""
    leaves, prior = scene.leaves(torch.float32, device), prior_of(scene, device)
    fixed, weights = Splats(*(part.detach() for part in leaves.splats())), upstream(leaves)

    def forward() -> object:
        with torch.no_grad():
            return render(leaves)

    def forward_backward() -> object:
        return torch.autograd.grad(render(leaves)[:3], leaves[:4], weights)

    passes = {"forward": forward, "forward+backward": forward_backward}
    if render is _d2:
        passes["survey"] = lambda: survey(fixed, scene.view, prior, SETTINGS)
    return passes


def timed(works: Mapping[str, Callable[[], object]], device: torch.device, seconds: float) -> dict[str, dict[str, Any]]:
    """Wall and CPU time of calls in ms, `works` in turn so that each sees the same machine.

    One round that is not counted, then at least three, for about `seconds` per work or until each ran 200 times.
    """
    for work in works.values():
        _finish(work(), device)
    wall: dict[str, list[float]] = {name: [] for name in works}
    cpu: dict[str, list[float]] = {name: [] for name in works}
    end, rounds = time.perf_counter() + seconds * len(works), 0
    while rounds < 3 or (time.perf_counter() < end and rounds < 200):
        for name, work in works.items():
            start, start_cpu = time.perf_counter(), time.process_time()
            _finish(work(), device)
            wall[name].append(1e3 * (time.perf_counter() - start))
            cpu[name].append(1e3 * (time.process_time() - start_cpu))
        rounds += 1
    return {name: _summary(wall[name], cpu[name]) for name in works}


def _summary(wall: Sequence[float], cpu: Sequence[float]) -> dict[str, Any]:
    low, middle, high = statistics.quantiles(wall, n=4)
    return {
        "median_ms": middle,
        "iqr_ms": high - low,
        "cpu_ms": statistics.median(cpu),
    }


def _finish(_result: object, device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


class Truth(NamedTuple):
    """The reference in float64, with its graph, for `error_of`."""

    render: Render
    scene: Scene


def exact(scene: Scene, device: torch.device) -> Truth:
    """Image of the reference in float64, computed on `device`."""
    leaves = scene.leaves(torch.float64, device)
    return Truth(_reference(leaves), leaves)


def error_of(render: RenderScene, scene: Scene, device: torch.device, truth: Truth) -> dict[str, dict[str, float]]:
    """Deviation from `exact`: of color, depth sum and alpha as it is; of gradients in units of their own RMS.

    In float32 an alpha or a transmittance just at its threshold may be decided differently, and what depends on that
    decision jumps. Such pixels are counted apart: gradients (`relative_l2` is the norm of their deviation over that of
    the truth) are those of a loss that leaves out the pixels whose color or alpha deviates by more than
    `THRESHOLD_DEVIATION`, whose share is in `apart`.
    """
    leaves = scene.leaves(torch.float32, device)
    found = render(leaves)
    pairs = zip(found[:3], truth.render[:3])
    deviations = [(part.detach().double() - true.detach()).abs().cpu() for part, true in pairs]
    apart = (deviations[0].amax(-1) > THRESHOLD_DEVIATION) | (deviations[2] > THRESHOLD_DEVIATION)
    kept = (~apart[..., None], ~apart, ~apart)
    weights = [torch.where(keep, weight, 0) for keep, weight in zip(kept, upstream(scene))]
    gradients = torch.autograd.grad(found[:3], leaves[:4], [w.to(device) for w in weights])
    upon = [w.to(device).double() for w in weights]
    expected = torch.autograd.grad(truth.render[:3], truth.scene[:4], upon, retain_graph=True)
    errors = {name: _quantiles(deviation) for name, deviation in zip(Render._fields, deviations)}
    for name, part, true in zip(Scene._fields, gradients, expected):
        true = true.cpu()
        deviation = part.cpu().double() - true
        scale = true.square().mean().sqrt().clamp(min=1e-300)
        relative = deviation.norm() / true.norm().clamp(min=1e-300)
        errors[f"grad {name}"] = {**_quantiles(deviation.abs() / scale), "relative_l2": relative.item()}
    errors["pixels"] = {"apart": apart.double().mean().item()}
    return errors


def _quantiles(deviation: Tensor) -> dict[str, float]:
    return {"p99.9": float(np.quantile(deviation, 0.999)), "max": deviation.max().item()}


def peak_memory(case: Case, name: str, device: torch.device) -> float:
    """Peak MB that forward and backward take beyond what was there before, inputs excluded.

    On the CPU resident memory in a fresh process (Linux; NaN elsewhere), on CUDA what torch's allocator handed out.
    """
    if device.type == "cuda":
        scene = case.load()
        work = passes_of(implementations(device, 0)[name], scene, device)["forward+backward"]
        torch.cuda.synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        _finish(work(), device)
        return (torch.cuda.max_memory_allocated(device) - before) / 1e6
    return in_fresh_process(_peak_resident, case, name).result


def _peak_resident(case: Case, name: str) -> float:
    renderers: Mapping[str, RenderScene] = implementations(torch.device("cpu"), 0)
    # A small scene first: compiling, loading and thread stacks are not the rasterizer's memory.
    passes_of(renderers[name], load_scene("synth:100", 64, 48), torch.device("cpu"))["forward+backward"]()
    return peak_resident(passes_of(renderers[name], case.load(), torch.device("cpu"))["forward+backward"]).peak_mb
