"""How a viewer follows any trainer: by the two calls of its D2Hooks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

from d2_plugin.hooks.reports import Report
from d2_plugin.plugin import D2Hooks
from d2_plugin.protocol import View
from d2_plugin.viewing.stand_in import subject_of_views
from d2_plugin.viewing.subject import Subject


class Watching(Protocol):
    """What follows: a `Viewer`."""

    subject: Subject | None
    marks: Any

    def after_step(self, step: int, loss: float | None = None) -> None: ...
    def aim(self) -> None: ...
    def score(self, text: str) -> None: ...


class Follower:
    """Listens to one `D2Hooks` of any trainer. Its cameras are learnt from the views that it trains on."""

    def __init__(self, d2: D2Hooks, viewer: Watching) -> None:
        self.d2, self.viewer = d2, viewer
        self.views: dict[tuple[str, int], View] = {}
        self.inserted = self.removed = 0
        self._cameras: list[Any] = []
        self._shown = 0
        viewer.marks = lambda: d2.inserted_at
        self._loss, self._step = d2.loss, d2.step
        d2.loss, d2.step = self._listening, self._stepping  # type: ignore[method-assign]

    def let_go(self) -> None:
        """The trainer's own methods again."""
        for name in ("loss", "step"):
            vars(self.d2).pop(name, None)

    def _listening(self, step: int, views: object) -> Any:
        result = self._loss(step, views)
        self._cameras += views if isinstance(views, (list, tuple)) else [views]
        return result

    def _stepping(self, step: int) -> Report:
        report = self._step(step)
        self.inserted, self.removed = self.inserted + report.inserted, self.removed + report.removed
        self.viewer.score(f"D2: {self.inserted} inserted, {self.removed} removed")
        self._learn()
        self.viewer.after_step(step)
        return report

    def _learn(self) -> None:
        """Note the views of this step; the first ones, and then each new camera or frame, make a new subject."""
        for camera in self._cameras:
            # A camera that came with its render is asked without it: the render must not be handed out again.
            view = self.d2.backbone.view(camera.camera if hasattr(camera, "package") else camera)
            self.views.setdefault((view.camera, view.frame), view)
        self._cameras.clear()
        if len(self.views) == self._shown:
            return
        first, self._shown = not self._shown, len(self.views)
        store = None if self.d2.prior is None else self.d2.prior.store
        name = type(self.d2.backbone).__name__
        subject = subject_of_views(list(self.views.values()), self.d2.backbone, store, name)
        self.viewer.subject = replace(subject, inserted_at=self.d2.inserted_at if self.d2.hooks else None)
        if first:
            self.viewer.aim()
