"""hustvl/4DGaussians (CVPR 2024): canonical 3D Gaussians deformed by a HexPlane field, trained in two stages.

    adapter = Hust4DAdapter(gaussians, scene, stage)
    d2 = D2Hooks.from_config("d2.toml", backbone=adapter, iterations=train_iter)   # train.py:52, in each stage
    loss = loss + d2.loss(iteration, viewpoint_cams)                               # before :219, the whole batch
    d2.step(iteration)                                                             # after :292, before the checkpoint

`scene_reconstruction` runs once per stage and calls `training_setup` anew, so line 1 runs twice on one model; the
adapter of the fine stage takes the place of the coarse one's. Iterations count from 1 in each.
"""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Any

import torch
from torch import Tensor

from d2_plugin.errors import refuse_unknown
from d2_plugin.gaussians.rotation4d import unit_quaternions
from d2_plugin.protocol import Points, Splats, View

from .inria import InriaAdapter, RenderedCamera
from .inverse_deformation import Inversion, invert_at_times
from .keys import KeyOf, PriorKey, key_from_image_name
from .shared import optional, seen_colors, splats_of

STAGES = ("coarse", "fine")


class Hust4DAdapter(InriaAdapter):
    """A `GaussianModel` of hustvl/4DGaussians as a `d2_plugin.protocol.Backbone`.

    The slice is that of its render (gaussian_renderer/__init__.py:79-98): offsets are added BEFORE the activations; in
    the coarse stage there are none, and the model is one still scene for all frames.

    Args:
        gaussians: the model, after `training_setup`.
        scene: its `Scene`; `image_name` and `uid` of a camera are only its place in the data set
            (scene/dataset.py:39), so the image's path, which says camera and frame, comes from
            `scene.train_camera.dataset`.
        stage: "coarse" or "fine", the variable of that name in `scene_reconstruction`.
        active_stages: the stages in which hooks run. The coarse one fits one still scene to all instants, which the
            prior of a moving surface contradicts, so it is left alone by default.
        key: finds the prior of a camera; needed where the image's path does not say camera and frame.
    """

    evidence = InriaAdapter.evidence | {"_deformation_accum": 0.0}

    def __init__(
        self,
        gaussians: Any,
        scene: Any,
        stage: str,
        *,
        active_stages: tuple[str, ...] = ("fine",),
        key: KeyOf | None = None,
    ) -> None:
        super().__init__(gaussians, key, optional(gaussians, "_deformation"))
        self.enter_stage(stage)
        self.active_stages = active_stages
        self.inversion: Inversion | None = None
        self._dataset = optional(optional(scene, "train_camera"), "dataset")

    def enter_stage(self, stage: str) -> None:
        """From now on the model is drawn as in this stage."""
        refuse_unknown("stage of scene_reconstruction", [stage], STAGES)
        self.stage = stage

    def active(self, step: int) -> bool:
        """Whether hooks run in this stage."""
        return self.stage in self.active_stages

    def slice_at(self, view: View) -> Splats:
        """The 3D Gaussians at `view.time`, differentiable in the model's and in the field's parameters."""
        xyz, log_scales, rotations, logits, _ = (
            self._evaluated(view, self._raw_at, view.time) if self.stage == "fine" else self._raw_at(view.time)
        )
        return splats_of(xyz, log_scales.exp(), unit_quaternions(rotations).T, torch.sigmoid(logits.squeeze(-1)))

    def colors(self, view: View, splats: Splats) -> Tensor:
        """RGB [M, 3] from the harmonics as the field leaves them: it deforms those too, unless `no_dshs` is set."""
        return seen_colors(
            self._raw_at(view.time)[4], view, splats, int(optional(self.gaussians, "active_sh_degree", 0))
        )

    def _raw_at(self, time: float) -> tuple[Tensor, ...]:
        """Positions, log-scales, quaternions, logits and harmonics of all rows at an instant, before activation."""
        model = self.gaussians
        raw = model._xyz, model._scaling, model._rotation, model._opacity, self._harmonics()
        return self._field(raw, time) if self.stage == "fine" and len(self) else raw

    def _field(self, raw: tuple[Tensor, ...], time: float) -> tuple[Tensor, ...]:
        times = raw[0].new_full((len(raw[0]), 1), time)
        moved: tuple[Tensor, ...] = self._own(self.gaussians._deformation, *raw, times)
        return moved

    def _time(self, camera: Any) -> float:
        """In 0..1 of the clip, unlike `timestamp` elsewhere."""
        return float(camera.time)

    def _default_key(self, camera: Any) -> PriorKey:
        return key_from_image_name(str(camera.image_name if self._dataset is None else self.image_name(camera)))

    def image_name(self, camera: Any) -> str | None:
        """Path of the image, from the data set: the camera's object has its place there and nothing more."""
        if isinstance(camera, RenderedCamera):
            camera = camera.camera
        if self._dataset is None or not hasattr(camera, "uid"):
            return None
        paths, index = optional(self._dataset, "image_paths"), int(camera.uid)
        if paths is not None:
            return str(paths[index])
        # Data sets of Blender, COLMAP and HyperNeRF give CameraInfo instead; the last one's path is the folder alone.
        info = self._dataset[index]
        path = PurePosixPath(str(info.image_path))
        return str(path if path.suffix else path / str(info.image_name))

    def _append(self, points: Points) -> None:
        """Canonical Gaussians that the field moves onto the points; those outside its grid are left out.

        Features are clamped to the border of the grid, whose box is that of the initial points (scene/__init__.py:83):
        a Gaussian outside would move with whatever passes the border.
        """
        points = self._inside(points)
        if self.stage == "fine" and len(points.positions):
            self.inversion = invert_at_times(points, self._deformed, self.gaussians._xyz.detach())
            points = self._inside(points._replace(positions=self.inversion.positions))
        table = torch.ones(len(points.positions), dtype=torch.bool, device=points.positions.device)
        self.gaussians.densification_postfix(*self._raw_rows(points), table)

    def _inside(self, points: Points) -> Points:
        box = self.gaussians._deformation.get_aabb
        box = box() if callable(box) else box
        corners = torch.stack([torch.as_tensor(corner).to(points.positions) for corner in box])
        low, high = corners.amin(0), corners.amax(0)
        inside = ((points.positions >= low) & (points.positions <= high)).all(-1)
        return points.select(inside)

    def _deformed(self, positions: Tensor, time: float) -> Tensor:
        return self._field(self._blank(positions), time)[0] if len(positions) else positions

    def _blank(self, positions: Tensor) -> tuple[Tensor, ...]:
        """Raw attributes of rows of which only the positions matter; the field's forward wants them all."""
        zeros, count = positions.new_zeros, len(positions)
        channels = self.gaussians._features_dc.shape[1] + self.gaussians._features_rest.shape[1]
        return positions, zeros(count, 3), zeros(count, 4), zeros(count, 1), zeros(count, channels, 3)
