"""The page in a real browser: it opens, names stay text, a training is watched, paused and goes on."""

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest
from tiny import ALL_HOOKS, make_trainer
from viewing.chromium import Page, browser, decoded

from d2_plugin.viewing.live import Viewer
from d2_plugin.viewing.viewed import KeptImages, ViewedRun

pytest.importorskip("viser", reason="viser is in the `view` extra")
pytestmark = pytest.mark.browser

FREE = {"x": 0, "y": 170, "width": 300, "height": 230}  # of the page, beside controls and notices
EVIL = "<script>window.hacked=1</script>"


@pytest.fixture(scope="module")
def new_page() -> Iterator[Callable[[], Page]]:
    with browser(640, 400) as new:
        yield new


@contextmanager
def showing(viewed: ViewedRun) -> Iterator[Viewer]:
    """A viewer whose images are drawn by a thread of its own, as `d2 view` draws them in its only one."""
    viewer, stop = Viewer(viewed=viewed, port=18080, height=180), threading.Event()
    thread = threading.Thread(target=viewer.stay, args=(stop.is_set,))
    thread.start()
    try:
        yield viewer
        assert thread.is_alive(), "what draws has stopped"
    finally:
        stop.set()
        thread.join()
        viewer.close()


def opened(new_page: Callable[[], Page], viewer: Viewer) -> Page:
    page = new_page().open(viewer.url)
    page.page.get_by_text("Recording", exact=True).wait_for(timeout=60_000)
    return page


def wait_for_image(page: Page) -> None:
    """Until something is drawn where neither controls nor notices are."""
    for _ in range(120):
        page.page.wait_for_timeout(250)
        if decoded(page.page.screenshot(clip=FREE)).std() > 2:
            return
    raise AssertionError("the page never showed it")


def control(page: Page, label: str) -> Any:
    """The input in the row of a label."""
    return page.page.locator(f'xpath=//label[text()="{label}"]/../../..').locator("input").first


def test_names_stay_text_and_only_this_machine_may_look(new_page: Callable[[], Page], viewed: ViewedRun) -> None:
    cameras = {EVIL if name == "train0" else name: camera for name, camera in viewed.recording.cameras.items()}
    recording = replace(viewed.recording, cameras=cameras, source=KeptImages(cameras))
    named = replace(viewed, name=EVIL, recording=recording, train_cameras=tuple(cameras), store=None, test_cameras=())
    with showing(named) as viewer:
        page = opened(new_page, viewer)
        assert control(page, "shown").input_value() == EVIL
        control(page, "stand at").click()
        page.page.get_by_role("option", name=EVIL, exact=True).wait_for()
        assert page.page.evaluate("window.hacked") is None
        assert page.errors == []
        own = ("http://localhost:", "ws://localhost:")
        assert all(url.startswith(own) for url in page.requests), "nothing comes from elsewhere"
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as way:
            way.connect(("192.0.2.1", 9))  # sends nothing; says which address this machine has towards others
            address = way.getsockname()[0]
        if not address.startswith("127."):
            with pytest.raises(OSError, match="refused"):
                socket.create_connection((address, viewer._server.get_port()), timeout=5)
        page.page.close()


def test_a_training_is_watched_paused_and_goes_on(new_page: Callable[[], Page]) -> None:
    trainer = make_trainer(ALL_HOOKS, iterations=10**6)
    viewer, stop = Viewer(trainer.d2, port=18080, height=90), threading.Event()

    def train() -> None:
        while not stop.is_set():
            trainer.run(min(trainer.step + 1, 60))  # the budget of the tiny scene; then the page is only shown
            if trainer.step == 60:
                viewer.after_step(60)
                stop.wait(0.01)

    thread = threading.Thread(target=train)
    thread.start()
    try:
        page = opened(new_page, viewer)
        wait_for_image(page)
        assert "Gaussians" in control(page, "step").input_value()
        assert "inserted" in control(page, "score").input_value()
        page.page.get_by_role("button", name="Pause", exact=True).click()
        page.page.get_by_role("button", name="Go on", exact=True).wait_for()
        assert viewer.training.paused
        page.page.get_by_role("button", name="Go on", exact=True).click()
        page.page.get_by_role("button", name="Pause", exact=True).wait_for()
        assert not viewer.training.paused
        assert page.errors == []
        page.page.close()
    finally:
        stop.set()
        viewer.training.paused = False
        thread.join()
        viewer.close()
