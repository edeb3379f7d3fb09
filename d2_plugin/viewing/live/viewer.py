"""A page in the browser that shows Gaussians while they train, or afterwards: one line in any trainer.

    viewer = Viewer(d2)              # after D2Hooks: the page at viewer.url shows the model as it trains

Images are drawn by the thread that trains, between two steps: nothing is locked, no half-edited model is shown, and
training is the same with and without. What goes wrong with one browser's page closes that page; the training goes on.
"""

from __future__ import annotations

import io
import logging
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import replace
from functools import partial
from typing import Any

from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.hooks.reports import Report
from d2_plugin.plugin import D2Hooks
from d2_plugin.protocol import View
from d2_plugin.values import checked_arguments, counted
from d2_plugin.viewing.camera_paths import Rig
from d2_plugin.viewing.live.images import Resolution, Share, draw
from d2_plugin.viewing.live.overlay import Overlay, frustum_size
from d2_plugin.viewing.live.page import Page, Training, vertical_angle
from d2_plugin.viewing.live.server import serve
from d2_plugin.viewing.viewed import ViewedRun, viewed_views

log = logging.getLogger(__name__)

WATCHED, MOVED = 0.05, 0.5
"""Share of a training's time that images may take: for somebody who only looks, and while somebody moves."""
MOVING_SECONDS = 0.06
"""An image while something moves may take this long."""


class Viewer:
    """The page, its clients, and what they see."""

    @checked_arguments
    def __init__(
        self,
        d2: D2Hooks | None = None,
        viewed: ViewedRun | None = None,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        height: int = 360,
        iterations: int | None = None,
    ) -> None:
        """Open the page.

        Args:
            d2: of a trainer; from here on the page follows its steps.
            viewed: what is shown; of a trainer, its cameras are learnt from the views that it trains on.
            host: address to listen at; the default is this machine alone, and "0.0.0.0" is every network that it is in.
            port: the next free one is taken where this one is in use.
            height: of an image at rest, pixels; a slider of each page chooses another.
            iterations: how long the training lasts, where that is known.
        """
        if d2 is None and viewed is None:
            raise D2Error("a viewer needs something to show: Viewer(d2), or viewed=")
        self.viewed = viewed
        """What is shown; None until a trainer's first step."""
        self.marks: Callable[[], Tensor | None] = lambda: None if self.viewed is None else self.viewed.inserted_at
        """Per Gaussian [N], the step at which D2 inserted it; None where that is not known."""
        self.training = Training(iterations) if d2 is not None or iterations is not None else None
        self.height, self.step = height, 0
        self._clients: dict[int, Any] = {}
        self._pages: dict[int, tuple[Page, Overlay]] = {}
        self._wake = threading.Event()
        self._resolution = Resolution()  # one for all pages: every image teaches what a pixel costs
        self._watched, self._moved, self._last = Share(WATCHED), Share(MOVED), time.monotonic()
        self._followed = None if d2 is None else Follower(d2, self)
        self._server, self.url = serve(host, port)
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)
        if viewed is not None:
            self.aim()

    @property
    def clients(self) -> int:
        """How many browsers look."""
        return len(self._clients)

    def after_step(self, step: int, loss: float | None = None) -> None:
        """A trainer has finished a step: draw what is due, and wait here while somebody pauses.

        A pause ends when the last browser is closed.
        """
        self.step = step
        now = time.monotonic()
        for share in (self._watched, self._moved):
            share.passes(now - self._last)
        self._last = now
        if not self.clients or self.viewed is None:
            return
        self._note_progress(step, loss)
        self._draw_all(within_share=True)
        while self.training is not None and self.training.paused and self._clients:
            self._note_progress(step, loss)
            self._draw_all()
            self._wait()
        self._last = time.monotonic()  # a pause is not time in which images could have been drawn

    def set_score(self, text: str) -> None:
        """Show a score beside the step."""
        if self.training is not None:
            self.training.scores = text

    def stay(self, until: Callable[[], bool] = lambda: False) -> None:
        """Go on showing until `until` says so, or for ever: after a training, or where nothing trains."""
        while not until():
            self._draw_all()
            self._wait()

    def close(self) -> None:
        """Take the page away and let go of the trainer."""
        if self._followed is not None:
            for name in ("loss", "step"):  # the trainer's own methods again
                vars(self._followed.d2).pop(name, None)
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def aim(self) -> None:
        """Let new clients begin in front of what the cameras look at, between them; behind all cameras where they are
        the show."""
        viewed = self.viewed
        if viewed is None:
            return
        cameras = viewed.training or list(viewed.recording.cameras.values())
        rig, initial = Rig.of(cameras, viewed.depth), self._server.initial_camera
        back = 1.0 if viewed.backbone is not None else 1.6
        initial.position = rig.focus + back * (rig.middle - rig.focus)
        initial.look_at, initial.up, initial.fov = rig.focus, rig.up, vertical_angle(cameras[0])

    # Called by threads of viser, which touch nothing but the table of clients.
    def _connected(self, client: Any) -> None:
        self._clients[client.client_id] = client
        self._wake.set()

    def _disconnected(self, client: Any) -> None:
        self._clients.pop(client.client_id, None)
        self._wake.set()

    def _open_pages(self) -> list[tuple[Page, Overlay]]:
        viewed, clients = self.viewed, dict(self._clients)
        for gone in self._pages.keys() - clients.keys():
            del self._pages[gone]
        if viewed is None:
            return []
        for number, client in clients.items():
            if number not in self._pages:
                page = Page(client, viewed, self.training, self.height, self._wake.set)
                self._pages[number] = page, Overlay(page, frustum_size(viewed))
                self._attempt(page, page.build)
            self._pages[number][0].viewed = viewed
        return list(self._pages.values())

    def _draw_all(self, within_share: bool = False) -> None:
        for page, overlay in self._open_pages():
            self._attempt(page, partial(self._draw, page, overlay, within_share))

    def _attempt(self, page: Page, act: Callable[[], None]) -> None:
        """Do something for a page; where that fails the page is given up, and nothing else."""
        try:
            act()
        except Exception as failure:
            if page.client.client_id not in self._clients:
                return  # somebody closed it meanwhile
            log.warning("a page of the live viewer is not drawn any more: %r", failure, exc_info=failure)
            self._disconnected(page.client)

    def _draw(self, page: Page, overlay: Overlay, within_share: bool) -> None:
        """Draw what one page wants if it has not got it; `within_share` keeps to what a training leaves for it."""
        now = time.monotonic()
        page.play(now)
        wish = page.wanted(now)
        if wish is None:
            return
        wanted, moving = wish
        share = self._moved if moving else self._watched
        if within_share and not share.due and page.drawn is not None:
            return
        page.show_training()
        if page.drawn != (wanted, self.step, moving):
            if page.viewed.backbone is not None:
                marks = self.marks()
                marked = None if marks is None else marks > 0
                draw(page, wanted, marked, MOVING_SECONDS if moving else None, self._resolution)
            page.drawn = wanted, self.step, moving
        overlay.refresh(page.viewed, wanted.time, moving)
        taken = time.monotonic() - now
        self._watched.spent += taken
        self._moved.spent += taken

    def _note_progress(self, step: int, loss: float | None) -> None:
        if self.training is None or self.viewed is None:
            return
        parts = [f"{step} of {self.training.total}" if self.training.total else str(step)]
        parts += [counted(len(self.viewed.backbone), "Gaussian")] if self.viewed.backbone is not None else []
        parts += [] if loss is None else [f"loss {loss:.4f}"]
        self.training.progress = ", ".join(parts) + (" (paused)" if self.training.paused else "")

    def _wait(self) -> None:
        """Until something changes; at rest a look now and then is enough to see that nothing did."""
        playing = any(page.ticked("play") for page, _ in self._pages.values())
        self._wake.wait(0.02 if playing else 0.1)
        self._wake.clear()


class Follower:
    """Wraps `loss` and `step` of one `D2Hooks`. The cameras are learnt from the views that are trained on."""

    def __init__(self, d2: D2Hooks, viewer: Viewer) -> None:
        self.d2, self.viewer = d2, viewer
        self.views: dict[tuple[str, int], View] = {}
        self._cameras: list[Any] = []
        self._shown = 0
        viewer.marks = lambda: d2.inserted_at
        self._plain_loss, self._plain_step = d2.loss, d2.step
        d2.loss, d2.step = self._loss, self._step  # type: ignore[method-assign]

    def _loss(self, step: int, views: object) -> Any:
        result = self._plain_loss(step, views)
        self._cameras += views if isinstance(views, (list, tuple)) else [views]
        return result

    def _step(self, step: int) -> Report:
        report = self._plain_step(step)
        self.viewer.set_score(f"D2: {self.d2.log.inserted} inserted, {self.d2.log.removed} removed")
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
        store = None if self.d2.prior is None else self.d2.prior.store
        viewed = viewed_views(list(self.views.values()), self.d2.backbone, store, type(self.d2.backbone).__name__)
        self.viewer.viewed = replace(viewed, inserted_at=self.d2.inserted_at if self.d2.hooks else None)
        if first:
            self.viewer.aim()
