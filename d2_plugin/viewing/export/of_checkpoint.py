"""What another trainer wrote, as a scene for export."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from d2_plugin.protocol import Splats
from d2_plugin.viewing.checkpoints import open_checkpoint
from d2_plugin.viewing.export.scene import Clip, ExportScene, harmonics_as_seen
from d2_plugin.viewing.paths import pose_of


def scene_of_checkpoint(
    path: Path, recording: Path | None, train_cameras: Sequence[str] | None, downscale: int
) -> tuple[ExportScene, str]:
    """The scene of a checkpoint with the cameras and the clip of its recording, and what a person should know of it.

    Raises:
        D2Error: what `open_checkpoint` refuses.
    """
    subject, loaded = open_checkpoint(path, recording, train_cameras, downscale)
    shown, backbone = subject.recording, subject.backbone
    first = subject.training[0]
    view = subject.view(pose_of(first), 0.0, (first.width, first.height), first.name)

    @torch.no_grad()
    def splats_at(time: float) -> Splats:
        at = replace(view, time=subject.time_offset + time * subject.time_scale)
        return Splats(*(part.detach().cpu() for part in backbone.slice_at(at)))

    clip = Clip(shown.frames, tuple(shown.seconds(frame) for frame in shown.frames), shown.fps)
    scene = ExportScene(
        shown.name,
        clip,
        tuple(subject.training),
        tuple(shown.cameras[name] for name in subject.test_cameras),
        backbone.settings,
        harmonics_as_seen(backbone, view) if loaded.harmonics is None else loaded.harmonics,
        splats_at,
        loaded.moving,
    )
    return scene, subject.note
