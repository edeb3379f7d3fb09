"""What a published evaluation on N3DV is made of, and what of it is not so here: a protocol is one row of `PROTOCOLS`.

The cameras of each are in `recordings/presets`. Read in liyw420/GC-4DGS (scripts/pre_dynerf/, configs/dynerf/,
metrics.py) and yangzf-1023/4C4D (scripts/n3v2blender.py, configs/dynerf/, train.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from d2_plugin.recordings import Recording
from d2_plugin.recordings.presets import VIEWS


@dataclass(frozen=True)
class Protocol:
    """One published evaluation."""

    cameras: str
    """What `--train-cameras` takes."""
    iterations: int
    metrics: tuple[str, ...]
    """Of metrics.json, those that are its code's own definitions."""
    differs: tuple[str, ...] = ()
    """What its code does otherwise than this package, whatever the recording."""
    size: tuple[int, int] = (1352, 1014)
    """Of the images."""
    frames: int = 300
    """Of the recording, from the first on."""


OF_BOTH = (
    "steps: published with four images each, here with one",
    "images: published halved by bicubic filtering, here by the mean of each block of pixels",
)
GC_4DGS = (
    *OF_BOTH,
    "starting points: published from MVSFormer and COLMAP's dense stereo, thinned; here triangulated features of the "
    "training cameras",
    "monocular depth: published from Depth Anything V2 large, metric; here what --mono-onnx or the recording has",
    "scores: published of the checkpoint that scores best, here of the last step",
)
OF_4C4D = (
    *OF_BOTH,
    "starting points: published from MASt3R on the training cameras; here triangulated features of them",
    "poses: published turned, centred and scaled; here as they are",
)
PROTOCOLS = {
    **{
        f"gc-4dgs-{n}": Protocol(
            f"protocol:gc-4dgs-{n}", 10_000, ("psnr", "ssim_3dgs", "ssim2", "lpips_vgg", "lpips"), GC_4DGS
        )
        for n in VIEWS
    },
    "4c4d": Protocol("protocol:4c4d", 30_000, ("psnr", "ssim_3dgs"), OF_4C4D),
    **{f"ours-{n}": Protocol(f"preset:{n}", 3000, ("psnr", "psnr_moving", "ssim1", "ssim2", "lpips")) for n in VIEWS},
}
"""By name. `ours` is this project's own, on N3DV."""


def differences(protocol: Protocol, recording: Recording, cameras: tuple[str, ...], iterations: int) -> Iterator[str]:
    """What the scores of a run rest on otherwise than the published ones do, a line each.

    Args:
        protocol: a row of `PROTOCOLS`.
        recording: all of its cameras, at the size and with the frames that are used.
        cameras: those that train.
        iterations: of the run.
    """
    first = recording.cameras[min(recording.cameras)]
    if (first.width, first.height) != protocol.size:
        yield f"images: published {protocol.size[0]}x{protocol.size[1]}, here {first.width}x{first.height}"
    if len(recording.frames) != protocol.frames:
        yield f"frames: published {protocol.frames}, here {len(recording.frames)}"
    if iterations != protocol.iterations:
        yield f"iterations: published {protocol.iterations}, here {iterations}"
    if protocol.differs:
        off = max(abs(recording.cameras[name].K.diagonal() / first.K.diagonal() - 1).max() for name in cameras)
        if off > 1e-6:
            yield f"intrinsics: published those of {first.name} for all; here each camera's, up to {off:.2%} apart"
        yield from protocol.differs
