"""Which training views an evaluation looks at: a stratified sample that visits all of them in turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from d2_plugin.hooks.expected import check_view
from d2_plugin.protocol import View


class ViewSampler:
    """Remembers every view that was trained on and hands them out camera by camera, each camera's frames in turn.

    The trainer never has to list its views: those seen so far are known, which is all of them after one epoch.
    """

    def __init__(self) -> None:
        self._views: dict[tuple[str, int], View] = {}
        self._queues: dict[str, list[int]] = {}  # frames of a camera that its present round has still to come to
        self._unseen: set[tuple[str, int]] = set()
        self._next_camera = 0
        self._moving = False

    def add(self, view: View) -> bool:
        """Remember a view; whether it was not known before."""
        new = (view.camera, view.frame) not in self._views
        if new:
            check_view(view)
            poses = [known.T_camera_world for known in self.instants(view.camera)[:1]]
            self._moving |= not all(torch.equal(pose, view.T_camera_world) for pose in poses)
            self._views[view.camera, view.frame] = view
            self._queues.setdefault(view.camera, []).append(view.frame)
            self._unseen.add((view.camera, view.frame))
        return new

    @property
    def unseen(self) -> int:
        """How many known views no sample had yet."""
        return len(self._unseen)

    @property
    def cameras(self) -> int:
        """How many cameras have been seen so far."""
        return len({camera for camera, _ in self._views})

    def instants(self, camera: str) -> list[View]:
        """The known views of one camera, in the order in which they were first seen."""
        return [view for view in self._views.values() if view.camera == camera]

    def beside(self, view: View) -> list[View]:
        """A known view of each camera, of the frame of `view` where there is one; none at all where a camera moves."""
        latest = {} if self._moving else {other.camera: other for other in self._views.values()}
        return [self._views.get((camera, view.frame), other) for camera, other in latest.items()]

    def sample(self, count: int, generator: torch.Generator) -> Sequence[View]:
        """At most `count` different views; over several calls every known view comes once before any comes again."""
        cameras = sorted({camera for camera, _ in self._views})
        chosen: dict[tuple[str, int], View] = {}
        for _ in range(count if cameras else 0):
            camera = cameras[self._next_camera % len(cameras)]
            self._next_camera += 1
            key = (camera, self._next_frame(camera, generator))
            chosen.setdefault(key, self._views[key])
        self._unseen -= chosen.keys()
        return list(chosen.values())

    def _next_frame(self, camera: str, generator: torch.Generator) -> int:
        queue = self._queues[camera]
        if not queue:
            queue += [frame for name, frame in self._views if name == camera]
        return queue.pop(int(torch.randint(len(queue), (1,), generator=generator)))

    def state_dict(self) -> dict[str, Any]:
        """The known views and the position in their order; tensors and plain values only."""
        return {
            "views": [vars(view).copy() for view in self._views.values()],
            "queues": {camera: list(queue) for camera, queue in self._queues.items()},
            "unseen": sorted(self._unseen),
            "next_camera": self._next_camera,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict()`."""
        self._views, self._moving = {}, False
        for view in state["views"]:
            self.add(View(**view))
        self._queues = {camera: list(queue) for camera, queue in state["queues"].items()}
        self._unseen = {(camera, frame) for camera, frame in state.get("unseen", ())}
        self._next_camera = state["next_camera"]
