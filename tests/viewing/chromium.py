"""A headless Chromium for tests of pages: no network, software WebGL, every complaint of the page is kept.

Takes Debian's `chromium` (or what `D2_CHROMIUM` names) through playwright, without playwright's own browsers.
"""

from __future__ import annotations

import base64
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
)


def executable() -> str:
    """Path of the browser; skips the test, by name, where there is none."""
    pytest.importorskip("playwright", reason="playwright is in the `test` extra")
    found = os.environ.get("D2_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip(f"no Chromium here: tried {', '.join(NAMES)}; install Debian's package `chromium`")
    return found


class Page:
    """One page: what it logged, what it asked the network for, and its JavaScript."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.complaints: list[str] = []
        self.errors: list[str] = []
        self.requests: list[str] = []
        page.on("console", lambda message: self._heard(message.type, message.text))
        page.on("pageerror", lambda error: (self.complaints.append(f"error: {error}"), self.errors.append(str(error))))
        page.on("request", lambda request: self._asked(request.url))

    def _heard(self, kind: str, text: str) -> None:
        # Readback stalls are what Chromium tells about slow reading of pixels, which the tests do on purpose.
        if kind in ("error", "warning") and "GPU stall due to ReadPixels" not in text:
            self.complaints.append(f"{kind}: {text}")

    def _asked(self, url: str) -> None:
        if not url.startswith(("file:", "data:", "blob:", "about:")):
            self.requests.append(url)

    def open(self, address: str | Path) -> Page:
        self.page.goto(address.as_uri() if isinstance(address, Path) else address, wait_until="load")
        return self

    def run(self, script: str, argument: Any = None) -> Any:
        """The value of a JavaScript expression or function; a promise is awaited."""
        return self.page.evaluate(script, argument)


@contextmanager
def browser(width: int = 960, height: int = 600) -> Iterator[Any]:
    """A browser of which each `new_page()` is a `Page`; offline, so that whatever asks for the network fails."""
    path = executable()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        program = driver.chromium.launch(executable_path=path, args=list(FLAGS))
        context = program.new_context(viewport={"width": width, "height": height})
        try:
            yield lambda: Page(context.new_page())
        finally:
            program.close()


def decoded(png: bytes) -> np.ndarray:
    """RGB uint8 [H, W, 3] of a PNG."""
    cv2 = pytest.importorskip("cv2", reason="opencv is in the `image` extra")
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def image(address: str) -> np.ndarray:
    """The image of a data: address, as canvas.toDataURL gives it."""
    return decoded(base64.b64decode(address.partition(",")[2]))
