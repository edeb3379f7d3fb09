"""How a viewer follows any trainer: by the two calls of its D2Hooks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

from torch import Tensor

from d2_plugin.hooks.reports import Report
from d2_plugin.plugin import D2Hooks
from d2_plugin.protocol import View
from d2_plugin.viewing.viewed import ViewedRun, viewed_views


class Following(Protocol):
    """What follows: a `Viewer`."""

    viewed: ViewedRun | None
    marks: Callable[[], Tensor | None]

    def after_step(self, step: int, loss: float | None = None) -> None: ...
    def aim(self) -> None: ...
    def set_score(self, text: str) -> None: ...


class Follower:
    """Wraps `loss` and `step` of one `D2Hooks`. The cameras are learnt from the views that are trained on."""

    def __init__(self, d2: D2Hooks, viewer: Following) -> None:
        self.d2, self.viewer = d2, viewer
        self.views: dict[tuple[str, int], View] = {}
        self.inserted = self.removed = 0
        self._cameras: list[Any] = []
        self._shown = 0
        viewer.marks = lambda: d2.inserted_at
        self._plain_loss, self._plain_step = d2.loss, d2.step
        d2.loss, d2.step = self._loss, self._step  # type: ignore[method-assign]

    def let_go(self) -> None:
        """The trainer's own methods again."""
        for name in ("loss", "step"):
            vars(self.d2).pop(name, None)

    def _loss(self, step: int, views: object) -> Any:
        result = self._plain_loss(step, views)
        self._cameras += views if isinstance(views, (list, tuple)) else [views]
        return result

    def _step(self, step: int) -> Report:
        report = self._plain_step(step)
        self.inserted, self.removed = self.inserted + report.inserted, self.removed + report.removed
        self.viewer.set_score(f"D2: {self.inserted} inserted, {self.removed} removed")
        self._note_views()
        self.viewer.after_step(step)
        return report

    def _note_views(self) -> None:
        """Note the views of this step; each new camera or frame changes what is shown."""
        for camera in self._cameras:
            # A camera that came with its render is asked without it: the render must not be handed out again.
            view = self.d2.backbone.view(camera.camera if hasattr(camera, "package") else camera)
            self.views.setdefault((view.camera, view.frame), view)
        self._cameras.clear()
        if len(self.views) == self._shown:
            return
        first, self._shown = not self._shown, len(self.views)
        store = getattr(getattr(self.d2, "_prior", None), "store", None)
        viewed = viewed_views(list(self.views.values()), self.d2.backbone, store, type(self.d2.backbone).__name__)
        self.viewer.viewed = replace(viewed, inserted_at=self.d2.inserted_at if self.d2.hooks else None)
        if first:
            self.viewer.aim()
