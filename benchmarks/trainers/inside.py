"""The process of one official trainer: the launcher's work, and afterwards what cannot be asked from outside.

    python -m benchmarks.trainers.inside OUTCOME SEED TRUTH [HELD_OUT] -- fudan --cpu --d2 d2.toml -- train.py ...

adds SEED to every seed that the script sets, and writes how many Gaussians there are and a digest of all trained
numbers to OUTCOME (JSON), so that two runs can be told to be the same to the last bit. Two repositories print no report
of held-out cameras; for them it prints one line, of images that their own code reads, draws and compares. Of the images
that a repository's own metric compares, what moves is scored as well, see `benchmarks.trainers.moving`.
"""

import hashlib
import logging
import random
import runpy
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.trainers import between
from benchmarks.trainers.moving import Moving
from d2_plugin.reading import json_text

PIPELINE = Namespace(convert_SHs_python=False, compute_cov3D_python=False, debug=False)
"""What the renderers of 3D Gaussian Splatting ask for, at its defaults."""


def main(words: list[str]) -> int:
    """Run the trainer; the exit code of the launcher."""
    from d2_plugin.attach.launch import parsed, prepare
    from d2_plugin.errors import D2Error

    logging.basicConfig(level=logging.INFO, format="d2: %(message)s")
    at = words.index("--")
    outcome_file, seed, truth, *held_out = words[:at]
    options, command = parsed(words[at + 1 :])
    move_seeds(int(seed))
    try:
        session = prepare(options, command)
        moving = Moving(Path(truth))
        moving.watch(options.repository)
        start = time.process_time()
        runpy.run_path(command[0], run_name="__main__")
        seconds, peak_mb = time.process_time() - start, most_memory()
    except D2Error as error:
        sys.stderr.write(f"d2: {error}\n")
        return 2
    objects = session.objects
    trained = [objects.model] if objects.deform is None else [objects.model, objects.deform]
    outcome = {"gaussians": count(objects.model), "digest": digest(trained), "cpu_seconds": round(seconds, 1)}
    if session.hooks is not None:
        session.end()
        log = session.hooks.log
        outcome |= {"inserted": log.inserted, "removed": log.removed}
    if options.repository in SCORERS:
        psnr = SCORERS[options.repository](objects, *map(Path, held_out))
        assert sys.__stdout__ is not None  # the trainers' safe_state puts another sys.stdout into its place
        sys.__stdout__.write(f"\n[held out] iteration {objects.options.iterations}: PSNR {psnr}\n")
    outcome |= {"psnr_moving": moving.score(), "peak_mb": peak_mb}
    outcome |= between.scores(lambda: session.recipe.backbone(objects), options.repository, Path(truth))
    Path(outcome_file).write_text(json_text(outcome, outcome_file), encoding="utf-8")
    return 0


def most_memory() -> int:
    """What this process has held at most, MB: of a GPU's memory, or of the host's where there is none."""
    on_gpu: int = torch.cuda.max_memory_allocated() >> 20
    status = Path("/proc/self/status").read_text(encoding="utf-8")  # since exec, unlike getrusage
    return on_gpu or int(status.partition("VmHWM:")[2].split()[0]) >> 10


def move_seeds(by: int) -> None:
    """From now on random, numpy and torch take every number for a seed plus `by`: most trainers set a constant."""

    def moved(original: Callable[..., Any]) -> Callable[..., Any]:
        # A loader's workers, which follow torch's seed, give numpy a list.
        return lambda seed=None, *more: original(seed + by if isinstance(seed, int) else seed, *more)

    if by:
        for module, name in ((random, "seed"), (np.random, "seed"), (torch, "manual_seed")):
            setattr(module, name, moved(getattr(module, name)))


def tensors(model: Any) -> Iterator[tuple[str, Tensor]]:
    """Everything that is trained, by name: parameters of the object, and those of the networks that it holds."""
    if hasattr(model, "splats"):
        yield from ((name, value.detach()) for name, value in sorted(model.splats.items()))
        return
    if isinstance(model, torch.nn.Module):  # cem-4dgs's
        yield from ((name, value.detach()) for name, value in sorted(model.named_parameters()))
        return
    for name, value in sorted(vars(model).items()):
        if isinstance(value, torch.nn.Module):
            yield from ((f"{name}.{inner}", tensor) for inner, tensor in value.state_dict().items())
        elif isinstance(value, torch.nn.Parameter):
            yield name, value.detach()


def digest(models: Iterable[Any]) -> str:
    """One number that changes with any bit of any trained tensor."""
    found = hashlib.sha256()
    for name, tensor in (item for model in models for item in tensors(model)):
        found.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}".encode())
        found.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return found.hexdigest()[:16]


def count(model: Any) -> int:
    """How many Gaussians are drawn: static ones and, where there are two tables, moving ones.

    A model with `_parent` keeps motions in its second table, which are not drawn.
    """
    found = dict(tensors(model))
    drawn = ("_xyz", "means") if hasattr(model, "_parent") else ("_xyz", "_xyz_motion", "means")
    return sum(len(found[name]) for name in drawn if name in found)


@torch.no_grad()
def score_hust4d(objects: Any, held_out: Path) -> float:
    """PSNR in dB of 4DGaussians over a folder of its layout `multipleview`, by its own reader, renderer and metric."""
    from gaussian_renderer import render
    from scene.dataset import FourDGSdataset
    from scene.dataset_readers import sceneLoadTypeCallbacks
    from utils.image_utils import psnr

    kind = "MultipleView"
    images = sceneLoadTypeCallbacks[kind](str(held_out)).train_cameras
    arguments, _ = objects.given["scene"]
    cameras = FourDGSdataset(images, arguments[0], kind)
    black = torch.zeros(3, device="cuda")  # which means the CPU where the trainer runs there

    def draw(camera: Any) -> Tensor:
        return render(camera, objects.model, PIPELINE, black, stage="fine", cam_type=kind)["render"]

    return mean_psnr((cameras[index] for index in range(len(cameras))), draw, psnr)


@torch.no_grad()
def score_spacetime(objects: Any) -> float:
    """PSNR in dB of SpacetimeGaussians' lite model over its own test cameras, by its own renderer and metric.

    Its test.py also asks for LPIPS, whose networks are downloaded, so it does not run everywhere.
    """
    from helper_train import getrenderpip, trbfunction
    from thirdparty.gaussian_splatting.utils.image_utils import psnr

    render, settings, rasterizer = getrenderpip("train_ours_lite")

    def draw(camera: Any) -> Tensor:
        named = {"basicfunction": trbfunction, "GRsetting": settings, "GRzer": rasterizer}
        return render(camera, objects.model, PIPELINE, torch.zeros(9, device="cuda"), **named)["render"]

    return mean_psnr(objects.scene.getTestCameras(), draw, psnr)


def mean_psnr(cameras: Iterable[Any], draw: Callable[[Any], Tensor], psnr: Callable[..., Tensor]) -> float:
    """Mean over cameras of the repository's own metric of its own images, clamped to 0..1, and the true ones."""
    scores = []
    for camera in cameras:
        drawn, true = draw(camera).clamp(0, 1).cpu(), camera.original_image[:3].float().cpu()
        scores.append(float(psnr(drawn[None], true[None]).mean()))
    return sum(scores) / len(scores)


SCORERS: dict[str, Callable[..., float]] = {"hust4d": score_hust4d, "spacetime": score_spacetime}

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
