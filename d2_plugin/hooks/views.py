"""Which training views an evaluation looks at: a stratified sample that visits all of them in turn; their rays."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from d2_plugin.hooks.expected import check_view
from d2_plugin.protocol import View

MOST = 64
"""Views of one sample, at most, of a recording that is long for its run."""


def back_project(view: View, pixels: Tensor, depth: Tensor) -> Tensor:
    """World points [K, 3] = Pi^-1(p, D) of pixels [K, 2] (column, row; integers) at planar depths [K]."""
    centres = torch.cat([pixels.to(depth) + 0.5, torch.ones_like(depth)[:, None]], -1)
    camera = torch.linalg.solve_ex(view.K.to(depth), centres.T).result.T * depth[:, None]
    rotation, translation = view.T_camera_world[:3, :3].to(depth), view.T_camera_world[:3, 3].to(depth)
    return (camera - translation) @ rotation  # R^T (x - t), row by row


class ViewSampler:
    """Remembers every view that was trained on and hands them out camera by camera, each camera's frames in turn.

    The trainer never has to list its views: those seen so far are known, which is all of them after one epoch.
    """

    def __init__(self) -> None:
        self._views: dict[tuple[str, int], View] = {}
        self._looks: dict[tuple[str, int], int] = {}  # in how many samples each was
        self._next_camera = 0
        self._moving = False

    def add(self, view: View) -> bool:
        """Remember a view; whether it was not known before."""
        new, device = (view.camera, view.frame) not in self._views, view.K.device
        if self._views and next(iter(self._views.values())).K.device != device:  # their state was loaded elsewhere
            for key, old in self._views.items():
                self._views[key] = replace(old, K=old.K.to(device), T_camera_world=old.T_camera_world.to(device))
        if new:
            check_view(view)
            poses = [known.T_camera_world for known in self.instants(view.camera)[:1]]
            self._moving |= not all(torch.equal(pose, view.T_camera_world) for pose in poses)
            self._looks[view.camera, view.frame] = 0
        self._views[view.camera, view.frame] = view  # where a trainer refines poses, the present one
        return new

    def due(self, left: float) -> int:
        """How many views to sample at least: one of each camera at first, and as many as it takes to come to all of
        them in `left` samples, up to `MOST`."""
        unseen = list(self._looks.values()).count(0)
        first = len({camera for camera, _ in self._views}) if unseen == len(self._views) else 0
        return max(first, min(math.ceil(unseen / left), MOST) if left else 0)

    def instants(self, camera: str) -> list[View]:
        """The known views of one camera, in the order in which they were first seen."""
        return [view for view in self._views.values() if view.camera == camera]

    def beside(self, view: View) -> list[View]:
        """A known view of each camera, of the frame of `view` where there is one; none at all where a camera moves."""
        latest = {} if self._moving else {other.camera: other for other in self._views.values()}
        return [self._views.get((camera, view.frame), other) for camera, other in latest.items()]

    def sample(self, count: int, generator: torch.Generator) -> Sequence[View]:
        """At most `count` different views, in turn over cameras; of each camera one that was in fewest samples."""
        cameras = sorted({camera for camera, _ in self._views})
        chosen: dict[tuple[str, int], View] = {}
        for _ in range(count if cameras else 0):
            camera = cameras[self._next_camera % len(cameras)]
            self._next_camera += 1
            fewest = min(looks for (name, _), looks in self._looks.items() if name == camera)
            keys = [key for key, looks in self._looks.items() if key[0] == camera and looks == fewest]
            key = keys[int(torch.randint(len(keys), (1,), generator=generator, device="cpu"))]
            self._looks[key] += 1
            chosen[key] = self._views[key]
        return list(chosen.values())

    def state_dict(self) -> dict[str, Any]:
        """The known views and the position in their order; tensors and plain values only."""
        return {
            "views": [vars(view).copy() for view in self._views.values()],
            "looks": list(self._looks.values()),
            "next_camera": self._next_camera,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict()`."""
        self._views, self._moving = {}, False
        for view in state["views"]:
            self.add(View(**view))
        self._looks = dict(zip(self._views, state.get("looks", [1] * len(self._views))))
        self._next_camera = state["next_camera"]
