"""The exported page in a real browser: offline, it plays, and what it shows is what our rasterizer draws."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from oracles.export_files import ReadPage
from viewing.chromium import Page, browser, executable, image
from viewing.export.scenes import DURATION, NASTY, make_scene, psnr, rasterized, sharp_model

from d2_plugin.backbones.model import SplatModel
from d2_plugin.backbones.yang4d import Yang4D, Yang4DSettings
from d2_plugin.runs.drawing import color_scale, colorize
from d2_plugin.viewing.export.page import write_page

pytestmark = pytest.mark.browser

TIMES = (0.0, 0.21, DURATION)
CAMERAS = ("</script><b>left", "middle", "right")


@pytest.fixture(scope="module")
def new_page() -> Iterator[Callable[[], Page]]:
    """Pages of one browser for all tests: starting it is what takes long."""
    executable()
    with browser(480, 360) as new:
        yield new


def opened(new_page: Callable[[], Page], model: SplatModel, path: Path, name: str = "tiny") -> Page:
    """The page of a model, loaded, standing still."""
    write_page(make_scene(model, name, CAMERAS), path)
    page = new_page()
    page.page.emulate_media(reduced_motion="reduce")
    page.open(path)
    page.run("d2.then((player) => player.count)")
    return page


def shown(page: Page, camera: int, time: float, mode: str = "color") -> np.ndarray:
    """The page's image of a camera, in 0..1."""
    script = "async ([name, time, mode]) => (await d2).image(name, time, mode)"
    return image(page.run(script, [CAMERAS[camera], time, mode])) / 255


def models() -> dict[str, tuple[SplatModel, float]]:
    """Models by name with the least agreement in dB: a baked field is straight between its keys.

    At 30 dB nobody sees a difference, but a missing blur would pass: images of the bytes of a screen agree better.
    """
    return {
        "4D Gaussians": (sharp_model("yang4d"), 45.0),
        "deformation field": (sharp_model("hexplane"), 28.0),
        "one instant": (sharp_model("yang4d", temporal=False), 45.0),
    }


@pytest.mark.parametrize("name", list(models()))
def test_the_page_shows_what_the_rasterizer_draws(new_page: Any, tmp_path: Path, name: str) -> None:
    model, least = models()[name]
    page = opened(new_page, model, tmp_path / "scene.html")
    for camera in (0, 2):
        for time in TIMES:
            true = rasterized(model, camera, time)
            assert psnr(shown(page, camera, time), true["color"]) > least, f"camera {camera}, {time} s"
    opacity = shown(page, 2, TIMES[1], "opacity")[..., 0]
    assert psnr(opacity, rasterized(model, 2, TIMES[1])["opacity"]) > least
    assert page.complaints == []
    assert page.requests == []


def test_without_its_background_the_page_would_not_pass(new_page: Any, tmp_path: Path) -> None:
    model = sharp_model("yang4d")
    page = opened(new_page, model, tmp_path / "scene.html")
    model.background = None
    assert psnr(shown(page, 2, TIMES[1]), rasterized(model, 2, TIMES[1])["color"]) < 28


def test_a_camera_that_looks_away_from_all_gaussians_shows_the_background(new_page: Any, tmp_path: Path) -> None:
    model = sharp_model("yang4d")
    scene = make_scene(model, "tiny", CAMERAS)
    around = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))  # half a turn about the vertical
    cameras = [replace(camera, T_camera_world=around.numpy() @ camera.T_camera_world) for camera in scene.test_cameras]
    write_page(replace(scene, test_cameras=tuple(cameras)), tmp_path / "scene.html")
    page = new_page().open(tmp_path / "scene.html")
    true = rasterized(model, 2, TIMES[1], around)
    assert true["opacity"].max() == 0
    assert true["color"].std() > 0.02
    assert psnr(shown(page, 2, TIMES[1]), true["color"]) > 45


def test_images_of_other_times_and_cameras_would_not_pass(new_page: Any, tmp_path: Path) -> None:
    model = sharp_model("yang4d")
    page = opened(new_page, model, tmp_path / "scene.html")
    here = shown(page, 2, TIMES[1])
    assert psnr(here, rasterized(model, 2, TIMES[2])["color"]) < 28
    assert psnr(here, rasterized(model, 1, TIMES[1])["color"]) < 28


@pytest.mark.parametrize("bits", [8, 5])
def test_harmonics_and_cosines_in_time_and_a_sky_are_drawn(
    new_page: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bits: int
) -> None:
    monkeypatch.setattr("d2_plugin.viewing.export.coded.HARMONIC_BITS", (bits,))
    plain = sharp_model("yang4d")
    rows = {name: value.detach() for name, value in plain.gaussians.parameters.items()}
    generator = torch.Generator().manual_seed(3)
    rows["harmonics"] = 0.2 * torch.randn(len(plain), 47, 3, generator=generator)
    model = Yang4D(rows, Yang4DSettings(sh_degree=3, sh_time_degree=2, background=True), 2.0, DURATION)
    assert model.background is not None
    with torch.no_grad():
        model.background.harmonics.normal_(0, 0.2, generator=generator)
    page = opened(new_page, model, tmp_path / "scene.html")
    for time in TIMES:
        assert psnr(shown(page, 2, time), rasterized(model, 2, time)["color"]) > 30


def test_the_depth_view_is_the_expected_depth_on_its_scale(new_page: Any, tmp_path: Path) -> None:
    model = sharp_model("yang4d")
    page = opened(new_page, model, tmp_path / "scene.html")
    true = rasterized(model, 1, TIMES[1])
    low, high = ReadPage(tmp_path / "scene.html").header["depth_range"]
    colors = colorize(true["depth"], low, high, color_scale("viridis")) * true["opacity"][..., None]
    assert psnr(shown(page, 1, TIMES[1], "depth"), colors / 255) > 30


def test_the_slider_and_the_play_button_move_time(new_page: Any, tmp_path: Path) -> None:
    page = opened(new_page, sharp_model("yang4d"), tmp_path / "scene.html")
    canvas = page.page.locator("#image")
    screen = """async () => {
        const p = await d2;
        while (p.busy || !p.drawnSharp) await new Promise((resolve) => setTimeout(resolve, 20));
        return document.getElementById('image').toDataURL('image/png');
    }"""
    before = image(page.run(screen))
    page.page.locator("#time").fill("0.4")
    assert page.run("d2.then((player) => player.time)") == pytest.approx(0.4)
    assert "0.40 s · frame 9" in page.page.locator("#clock").inner_text()
    page.page.wait_for_timeout(400)
    after = image(page.run(screen))
    assert np.abs(after.astype(int) - before).mean() > 1
    page.page.locator("#play").click()
    page.page.wait_for_function("d2.then((player) => player.playing && player.time !== 0.4)")
    page.page.locator("#play").click()
    assert page.run("d2.then((player) => player.playing)") is False
    box = canvas.bounding_box()
    page.page.mouse.move(box["x"] + 100, box["y"] + 100)
    page.page.mouse.down()
    page.page.mouse.move(box["x"] + 160, box["y"] + 120)
    page.page.mouse.up()
    assert page.run("d2.then((player) => player.camera.moved)") is True
    page.page.locator("#back").click()
    assert page.run("d2.then((player) => player.camera.moved)") is False
    assert page.complaints == []


def test_images_are_coarser_only_where_that_makes_them_quicker(new_page: Any, tmp_path: Path) -> None:
    page = opened(new_page, sharp_model("yang4d"), tmp_path / "scene.html")
    paced = """([fixed, pixel]) => {
        const pace = new Pace(), full = 960 * 554;
        let coarse = 2;
        for (let i = 0; i < 40; i++) {
            const pixels = full / coarse ** 2;
            pace.note(pixels, fixed + pixel * pixels);
            coarse = pace.coarse(full, coarse);
        }
        return coarse;
    }"""
    assert page.run(paced, [0.001, 1e-9]) == 1, "a graphics card"
    pixels = 960 * 554 / page.run(paced, [0.001, 1e-6]) ** 2
    assert pixels * 1e-6 == pytest.approx(1 / 15, rel=0.1), "what pixels cost is saved"
    assert page.run(paced, [0.12, 5e-8]) < 1.2, "what Gaussians cost is not"


def test_names_with_markup_stay_text(new_page: Any, tmp_path: Path) -> None:
    page = new_page()
    asked: list[str] = []
    page.page.on("dialog", lambda dialog: (asked.append(dialog.message), dialog.dismiss()))
    write_page(make_scene(sharp_model("yang4d"), NASTY, CAMERAS), tmp_path / "scene.html")
    page.open(tmp_path / "scene.html")
    page.run("d2.then((player) => player.count)")
    assert page.page.title() == NASTY
    assert page.page.locator("#name").inner_text() == NASTY
    assert page.page.locator("#camera option").all_text_contents()[0] == CAMERAS[0]
    assert page.page.locator("body b").count() == 0
    assert asked == []
    assert page.complaints == []


def test_a_page_whose_data_is_damaged_says_so(new_page: Any, tmp_path: Path) -> None:
    path = tmp_path / "scene.html"
    write_page(make_scene(sharp_model("yang4d")), path)
    text = path.read_text()
    place = text.index('<script id="data"') + 60
    path.write_text(text[:place] + "AAAA" + text[place + 4 :])
    page = new_page().open(path)
    page.page.wait_for_function("!document.getElementById('message').textContent.startsWith('reading')")
    assert page.page.locator("#message").is_visible()
