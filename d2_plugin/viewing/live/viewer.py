"""A page in the browser that shows Gaussians while they train, or afterwards: one line in any trainer.

    viewer = Viewer(d2)              # after D2Hooks: http://localhost:8080 shows the model as it trains

Images are drawn by the thread that trains, between two steps: nothing is locked, and no half-edited model is shown.
Training is the same with and without: the viewer reads, draws nothing at random, and waits where somebody pauses.
"""

from __future__ import annotations

import io
import math
import socket
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from types import ModuleType
from typing import Any

from torch import Tensor

from d2_plugin.errors import D2Error, missing_extra
from d2_plugin.plugin import D2Hooks
from d2_plugin.values import checked_arguments
from d2_plugin.viewing.live.draw import Drawer
from d2_plugin.viewing.live.follow import Follower
from d2_plugin.viewing.live.overlay import Overlay, frustum_size, rig_of
from d2_plugin.viewing.live.pace import Share
from d2_plugin.viewing.live.page import Page, Training
from d2_plugin.viewing.subject import Subject

WATCHED, MOVED = 0.05, 0.5
"""Share of a training's time that images may take: for somebody who only looks, and while somebody moves."""
MOVING_SECONDS = 0.06
"""An image while something moves may take this long."""


class Viewer:
    """The page, its clients, and what they look at."""

    @checked_arguments
    def __init__(
        self,
        d2: D2Hooks | None = None,
        subject: Subject | None = None,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        height: int = 360,
        iterations: int | None = None,
    ) -> None:
        """Open the page.

        Args:
            d2: of a trainer; from here on the page follows its steps.
            subject: what is shown; of a trainer, its cameras are learnt from the views that it trains on.
            host: address to listen at; the default is this machine alone, and "0.0.0.0" lets everybody in.
            port: the next free one is taken where this one is in use.
            height: of an image at rest, pixels; half-open menus let each client choose another.
            iterations: how long the training lasts, where that is known.
        """
        if d2 is None and subject is None:
            raise D2Error("a viewer needs something to show: Viewer(d2), or a subject")
        self.subject = subject
        """What is shown; None until a trainer's first step says it."""
        self.marks: Callable[[], Tensor | None] = lambda: None if self.subject is None else self.subject.inserted_at
        """Per Gaussian [N], the step at which D2 inserted it; None where nobody knows."""
        self.training = Training(iterations) if d2 is not None or iterations is not None else None
        self.height, self.step = height, 0
        self._waiting: list[Any] = []
        self._pages: dict[int, tuple[Page, Overlay]] = {}
        self._wake, self._guard = threading.Event(), threading.Lock()
        self._drawer = Drawer()
        self._watched, self._moved, self._last = Share(WATCHED), Share(MOVED), time.monotonic()
        self._followed = None if d2 is None else Follower(d2, self)
        self._server = _serve(host, port)
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)
        if subject is not None:
            self.aim()

    @property
    def url(self) -> str:
        """Where the page is."""
        host = self._server.get_host()
        return f"http://{'localhost' if host in ('127.0.0.1', '0.0.0.0') else host}:{self._server.get_port()}"

    @property
    def clients(self) -> int:
        """How many browsers look."""
        return len(self._pages) + len(self._waiting)

    def after_step(self, step: int, loss: float | None = None) -> None:
        """A trainer has finished a step: draw what is due, and wait here while somebody pauses.

        A pause ends when the last browser is closed.
        """
        self.step = step
        self._pass_time()
        if not self.clients or self.subject is None:
            return
        self._tell(step, loss)
        self._draw_all(within_share=True)
        while self.training is not None and self.training.paused and self._pages:
            self._tell(step, loss)
            self._draw_all()
            self._wait()
        self._last = time.monotonic()  # a pause is not time in which images could have been drawn

    def score(self, text: str) -> None:
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
            self._followed.let_go()
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def aim(self) -> None:
        """Let new clients begin where the first training camera stands; behind all cameras where they are the show."""
        subject = self.subject
        if subject is None:
            return
        camera = subject.training[0] if subject.train_cameras else next(iter(subject.recording.cameras.values()))
        T, initial = camera.T_camera_world, self._server.initial_camera
        eye, up, ahead = camera.centre, -T[1, :3], T[2, :3]
        target = eye + (subject.depth or 3.0) * ahead
        if subject.backbone is None:
            middle, reach = rig_of(subject)
            target, eye = middle + reach * ahead, middle - 1.1 * reach * ahead + 0.5 * reach * up
        initial.position, initial.look_at, initial.up = eye, target, up
        initial.fov = 2 * math.atan(camera.height / 2 / camera.K[1, 1])

    def _connected(self, client: Any) -> None:
        with self._guard:
            self._waiting.append(client)
        self._wake.set()

    def _disconnected(self, client: Any) -> None:
        with self._guard:
            self._waiting = [other for other in self._waiting if other.client_id != client.client_id]
            self._pages.pop(client.client_id, None)
        self._wake.set()

    def _open_pages(self) -> list[tuple[Page, Overlay]]:
        """The pages of all clients; those that came since the last look are laid out."""
        subject = self.subject
        if subject is None:
            return []
        with self._guard:
            waiting, self._waiting = self._waiting, []
        for client in waiting:
            page = Page(client, subject, self.training, self.height, self._wake.set)
            page.build()
            with self._guard:
                self._pages[client.client_id] = page, Overlay(page, frustum_size(subject))
        with self._guard:
            pages = list(self._pages.values())
        for page, _ in pages:
            page.subject = subject
        return pages

    def _draw_all(self, within_share: bool = False) -> None:
        for page, overlay in self._open_pages():
            self._draw(page, overlay, within_share)

    def _draw(self, page: Page, overlay: Overlay, within_share: bool) -> None:
        """Draw what one page wants if it has not got it; `within_share` keeps to what a training leaves for it."""
        now = time.monotonic()
        page.play(now)
        found = page.wanted(now)
        if found is None:
            return
        wanted, moving = found
        share = self._moved if moving else self._watched
        if within_share and not share.due and page.drawn is not None:
            return
        page.tell_training()
        if page.drawn != (wanted, self.step, moving):
            if page.subject.backbone is not None:
                marks = self.marks()
                marked = None if marks is None else marks > 0
                self._drawer.draw(page, wanted, marked, MOVING_SECONDS if moving else None)
            page.drawn = wanted, self.step, moving
        overlay.refresh(page.subject, wanted.time, moving)
        taken = time.monotonic() - now
        self._watched.spend(taken)
        self._moved.spend(taken)

    def _tell(self, step: int, loss: float | None) -> None:
        training, subject = self.training, self.subject
        if training is None or subject is None:
            return
        of = f" of {training.total}" if training.total else ""
        count = f", {len(subject.backbone)} Gaussians" if subject.backbone is not None else ""
        said = f"{step}{of}{count}" + ("" if loss is None else f", loss {loss:.4f}")
        training.said = f"{said} (paused)" if training.paused else said

    def _pass_time(self) -> None:
        now = time.monotonic()
        for share in (self._watched, self._moved):
            share.passes(now - self._last)
        self._last = now

    def _wait(self) -> None:
        """Until something changes; at rest a look now and then is enough to see that nothing did."""
        with self._guard:
            playing = any(page.value("play", False) for page, _ in self._pages.values())
        self._wake.wait(0.02 if playing else 0.1)
        self._wake.clear()


def viser() -> ModuleType:
    """The module viser.

    Raises:
        MissingExtra: where it is not installed.
    """
    try:
        import viser
    except ImportError:
        raise missing_extra("viser", "view", "the live viewer") from None
    return viser


def _refuse_foreign(host: str) -> None:
    """Raise where nothing can listen at an address: viser would try one port after the other, for ever."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as failure:
        reason = getattr(failure, "strerror", None) or failure
        raise D2Error(
            f"nothing can listen at {host!r} ({reason}): give an address of this machine, or leave --host out"
        ) from None


def _serve(host: str, port: int) -> Any:
    _refuse_foreign(host)
    with redirect_stdout(io.StringIO()):  # it prints a table with addresses; we say ours in one line
        server = viser().ViserServer(host=host, port=port, label="D2-4DGS", verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True, control_width="medium")
    return server
