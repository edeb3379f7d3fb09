"""The exported page in a real browser: offline, it plays, and what it shows is what our rasterizer draws."""

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from oracles.export_files import ReadPage
from viewing.chromium import Page, browser, image
from viewing.export.scenes import DURATION, NASTY, make_scene, psnr, rasterized, sharp_model, with_harmonics

from d2_plugin.backbones.model import SplatModel
from d2_plugin.runs.drawing import color_scale, colorize
from d2_plugin.viewing.export.page import write_page

pytestmark = pytest.mark.browser

CAMERAS = ("</script><b>left", "middle", "right")


@pytest.fixture(scope="module")
def new_page() -> Iterator[Callable[[], Page]]:
    """Pages of one browser for all tests: starting it is what takes long."""
    with browser(480, 360) as new:
        yield new


def opened(page: Page, model: SplatModel, path: Path) -> Page:
    """The page of a model, loaded, standing still."""
    write_page([make_scene(model, "tiny", CAMERAS)], path)
    return begun(page, path)


def begun(page: Page, address: str | Path) -> Page:
    """The page as it is when somebody opens it."""
    page.page.emulate_media(reduced_motion="reduce")
    page.open("about:blank").open(address)  # another fragment of the same address would not load it again
    drawn(page)
    return page


def shown(page: Page, camera: int, time: float, mode: str = "color") -> np.ndarray:
    """The page's image of a camera, in 0..1."""
    script = "async ([name, time, mode]) => (await d2).image(name, time, mode)"
    return image(page.run(script, [CAMERAS[camera], time, mode])) / 255


def drawn(page: Page) -> np.ndarray:
    """What the canvas shows at rest, in 0..1."""
    script = """async () => {
        const p = await d2;
        p.change();
        do await new Promise((resolve) => setTimeout(resolve, 20)); while (p.busy || p.wanted || !p.sharp);
        return document.getElementById('image').toDataURL('image/png');
    }"""
    return image(page.run(script)) / 255


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pages")


@pytest.fixture(scope="module")
def moving(new_page: Callable[[], Page], folder: Path) -> Page:
    """The page of 4D Gaussians, for tests that leave it as it is."""
    return opened(new_page(), sharp_model("yang4d"), folder / "moving.html")


MODELS: dict[str, tuple[Callable[[], SplatModel], float]] = {
    "4D Gaussians": (lambda: sharp_model("yang4d"), 45.0),
    "deformation field": (lambda: sharp_model("deform"), 28.0),
    "one instant": (lambda: sharp_model("yang4d", temporal=False), 45.0),
    "harmonics and cosines in time": (lambda: with_harmonics(in_time=True), 30.0),
}
"""Models by name with the least agreement in dB: a baked field is straight between its keys.

At 30 dB nobody sees a difference, but a missing blur would pass: images of the bytes of a screen agree better."""


@pytest.mark.parametrize("name", list(MODELS))
def test_the_page_shows_what_the_rasterizer_draws(new_page: Callable[[], Page], tmp_path: Path, name: str) -> None:
    make, least = MODELS[name]
    model = make()
    page = opened(new_page(), model, tmp_path / "scene.html")
    for camera, time in ((0, 0.0), (2, 0.21), (2, DURATION)):
        true = rasterized(model, camera, time)
        assert psnr(shown(page, camera, time), true["color"]) > least, f"camera {camera}, {time} s"
    assert psnr(shown(page, 2, DURATION, "opacity")[..., 0], true["opacity"]) > least
    assert page.complaints == []
    assert page.requests == []


def test_the_depth_view_is_the_expected_depth_on_its_scale(moving: Page, folder: Path) -> None:
    true = rasterized(sharp_model("yang4d"), 1, 0.21)
    low, high = ReadPage(folder / "moving.html").header["depth_range"]
    colors = colorize(true["depth"], low, high, color_scale("viridis")) * true["opacity"][..., None]
    assert psnr(shown(moving, 1, 0.21, "depth"), colors / 255) > 30


def test_images_are_coarser_only_where_that_makes_them_quicker(moving: Page) -> None:
    paced = """([fixed, pixel]) => {
        const pace = new Pace(), size = [960, 554], full = size[0] * size[1];
        for (let i = 0; i < 40; i++) {
            const pixels = full / pace.coarse ** 2;
            pace.note(pixels, fixed + pixel * pixels, size);
        }
        return pace.coarse;
    }"""
    assert moving.run(paced, [0.001, 1e-9]) == 1, "a graphics card"
    pixels = 960 * 554 / moving.run(paced, [0.001, 1e-6]) ** 2
    assert pixels * 1e-6 == pytest.approx(1 / 15, rel=0.15), "what pixels cost is saved"
    assert moving.run(paced, [0.12, 5e-8]) < 1.2, "what Gaussians cost is not"


def test_the_slider_and_the_play_button_move_time(new_page: Callable[[], Page], tmp_path: Path) -> None:
    page = opened(new_page(), sharp_model("yang4d"), tmp_path / "scene.html")
    before = drawn(page)
    page.page.locator("#time").fill("0.4")
    assert page.run("d2.then((player) => player.time)") == pytest.approx(0.4)
    assert np.abs(drawn(page) - before).mean() > 1 / 255
    assert page.page.locator("#clock").text_content() == "0.40 s · frame 9"
    page.page.locator("#play").click()
    page.page.wait_for_function("d2.then((player) => player.playing && player.time !== 0.4)")
    page.page.locator("#play").click()
    assert page.run("d2.then((player) => player.playing)") is False
    box = page.page.locator("#image").bounding_box()
    page.page.mouse.move(box["x"] + 100, box["y"] + 100)
    page.page.mouse.down()
    page.page.mouse.move(box["x"] + 160, box["y"] + 120)
    page.page.mouse.up()
    assert page.run("d2.then((player) => player.camera.moved)") is True
    page.page.keyboard.press("h")
    assert page.run("d2.then((player) => player.camera.moved)") is False
    page.page.keyboard.press("o")
    for act, key in (("down", "KeyW"), ("down", "Shift"), ("up", "KeyW"), ("up", "Shift")):
        getattr(page.page.keyboard, act)(key)
    assert page.run("d2.then((player) => [player.held.size, player.swinging])") == [0, False], "it flies on"
    assert page.complaints == []


def test_in_an_image_of_more_pixels_the_blur_is_of_the_recordings(new_page: Callable[[], Page], tmp_path: Path) -> None:
    model = sharp_model("yang4d")
    with torch.no_grad():
        model.gaussians["log_scales"][:, 1:] -= 3  # thinner than a pixel
    page = opened(new_page(), model, tmp_path / "scene.html")
    script = """async (name) => {
        const p = await d2, free = new FreeCamera(p.header), camera = p.header.cameras.find((c) => c.name === name);
        free.place(camera);
        return p.still(free.view(2 * camera.width, 2 * camera.height), 0, "color", [{ what: 0, until: 1 }]);
    }"""
    seen = image(page.run(script, CAMERAS[2])) / 255
    assert psnr(seen, rasterized(model, 2, 0.0, finer=2)["color"]) < 40, "as sharp as its own pixels"
    raster = replace(model.settings.raster, blur=4 * model.settings.raster.blur)
    model.settings = replace(model.settings, raster=raster)
    assert psnr(seen, rasterized(model, 2, 0.0, finer=2)["color"]) > 45


@pytest.fixture(scope="module")
def two_models(new_page: Callable[[], Page], folder: Path) -> Page:
    scenes = []
    for name, model in (("bare", sharp_model("yang4d", 100)), ("D2", sharp_model("yang4d"))):
        scene = make_scene(model, "tiny", CAMERAS)
        viewed = replace(scene.viewed, name=name, scores={"": 20.0, "right": 21.5})
        scenes.append(replace(scene, viewed=viewed))
    write_page(scenes, folder / "two.html")
    return new_page()


@pytest.fixture
def compared(two_models: Page, folder: Path) -> Page:
    """A page of two models as it is opened, at the held-out camera, standing still."""
    return begun(two_models, folder / "two.html")


def alone(page: Page, what: int | str, time: float = 0.0) -> np.ndarray:
    """The held-out camera's image of one side, in the size of the canvas, in 0..1."""
    script = """async ([what, time]) => {
        const p = await d2, at = p.camera.camera, photo = what === 'recorded' && await p.photos.ready(at, time);
        const one = photo ? { image: photo, size: [at.width, at.height] } : what;
        return p.still(p.screenView(1), time, 'color', [{ what: one, until: 1 }]);
    }"""
    return image(page.run(script, [what, time])) / 255


class TestTheWipe:
    def test_each_side_is_the_image_of_its_model_and_the_labels_say_which(self, compared: Page) -> None:
        whole, sides = drawn(compared), [alone(compared, 0), alone(compared, 1)]
        middle = whole.shape[1] // 2
        assert np.abs(whole[:, : middle - 1] - sides[0][:, : middle - 1]).max() < 1e-6
        assert np.abs(whole[:, middle + 1 :] - sides[1][:, middle + 1 :]).max() < 1e-6
        assert psnr(*sides) < 30, "the models differ"
        said = [compared.page.locator(f"#{side}side").inner_text() for side in ("left", "right")]
        assert said == ["bare\n21.5 dB at this camera", "D2\n21.5 dB at this camera"]

    def test_the_recorded_image_stands_where_the_render_does_and_only_at_its_camera(self, compared: Page) -> None:
        compared.page.locator("#more").click()
        compared.page.locator("#left").select_option("recorded")
        compared.page.locator("#image").focus()
        left = drawn(compared)[:, : compared.run("document.getElementById('image').width") // 2 - 2]
        assert np.abs(left - 60 / 255).max() < 0.02
        assert compared.page.locator("#leftside").inner_text() == "recorded"
        compared.page.keyboard.press("h")
        assert drawn(compared).std() > 0.02
        assert compared.page.locator("#leftside").inner_text() == "D2\n20.0 dB held out"
        assert compared.page.locator("#wipe").is_hidden()

    def test_its_knob_is_dragged_and_moved_by_keys(self, compared: Page) -> None:
        box = compared.page.locator("#wipe").bounding_box()
        compared.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 40)
        compared.page.mouse.down()
        compared.page.mouse.move(box["x"] + box["width"] / 4, box["y"] + 40, steps=4)
        compared.page.mouse.up()
        share = compared.run("d2.then((p) => p.sides()[0].until)")
        assert share == pytest.approx(0.25, abs=0.02)
        assert compared.run("d2.then((p) => p.camera.moved)") is False
        compared.page.locator("#wipe").press("ArrowRight")
        assert compared.run("d2.then((p) => p.sides()[0].until)") > share


class TestTheFreeCamera:
    def test_it_stays_where_cameras_stood(self, compared: Page) -> None:
        pushed = """async () => {
            const p = await d2, places = [];
            const acts = [(c) => c.orbit(0.3, 0), (c) => c.orbit(0, 0.3), (c) => c.approach(3), (c) => c.fly([2, 1, 0])
            ];
            for (const act of acts) {
                p.camera.place(p.header.home);
                for (let i = 0; i < 40; i++) act(p.camera);
                places.push([p.camera.polar(), p.camera.edge]);
            }
            return [places, p.header.limits];
        }"""
        places, limits = compared.run(pushed)
        for place, edge in places:
            assert edge > 0.9, "at an end the image fades"
            for name, (low, high) in limits.items():
                assert low - 1e-6 <= place[name] <= high + 1e-6
        assert compared.run("d2.then((p) => { p.camera.place(p.header.home); return p.camera.edge; })") == 0

    def test_keys_fly_turn_and_go_home(self, compared: Page) -> None:
        where = "d2.then((p) => p.camera.centre)"
        compared.page.keyboard.press("h")
        home = compared.run(where)
        away = f"d2.then((p) => p.camera.moved && p.camera.centre.some((x, i) => Math.abs(x - {home}[i]) > 1e-3))"
        for key in ("w", "a", "ArrowLeft"):
            compared.page.keyboard.down(key)
            compared.page.wait_for_function(away)
            compared.page.keyboard.up(key)
            compared.page.keyboard.press("h")
        assert compared.run(where) == home
        compared.page.keyboard.press("c")
        assert compared.page.locator("#mode").input_value() == "depth"

    def test_it_orbits_by_itself_and_a_link_brings_the_view_back(self, compared: Page) -> None:
        compared.page.locator("#more").click()
        compared.page.locator("#orbit").click()
        compared.page.wait_for_function("d2.then((p) => Math.abs(p.camera.polar().azimuth) > 0.01)")
        compared.page.locator("#orbit").click()
        compared.page.locator("#time").fill("0.25")
        compared.page.locator("#link").click()
        state = "d2.then((p) => [p.camera.centre, p.time, p.camera.moved])"
        before = compared.run(state)
        assert "#left=0&right=1&wipe=0.5" in compared.page.url
        centre, time, moved = begun(compared, compared.page.url).run(state)
        assert np.abs(np.array(centre) - before[0]).max() < 1e-4
        assert (time, moved) == (before[1], True)


def test_a_phone_has_one_row_of_controls_large_enough_and_an_image_without_what_nobody_recorded(compared: Page) -> None:
    phone = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    context = compared.page.context.browser.new_context(**phone)
    page = begun(Page(context.new_page()), compared.page.url)
    boxes = [page.page.locator(f"#{name}").bounding_box() for name in ("play", "time", "camera", "more")]
    assert max(box["y"] for box in boxes) - min(box["y"] for box in boxes) < 2, "one row"
    assert min(min(box["width"], box["height"]) for box in boxes) >= 44
    assert max(box["x"] + box["width"] for box in boxes) <= 390
    image = page.page.locator("#image").bounding_box()
    assert image["width"] == 390
    assert image["width"] / image["height"] == pytest.approx(0.8, abs=0.01)
    view = page.run("d2.then((p) => [p.screenView(1).scale, p.screenView(1).size, p.camera.camera.height])")
    assert view[0] * view[2] == pytest.approx(view[1][1], rel=0.01), "the recorded height fills it"
    page.page.locator("#more").tap()
    hidden = [page.page.locator(f"#{name}").bounding_box() for name in ("orbit", "left", "about", "full")]
    assert min(box["height"] for box in hidden) >= 44
    assert min(box["x"] for box in hidden) >= 0
    assert max(box["x"] + box["width"] for box in hidden) <= 390
    context.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_serious_barrier_in_light_or_dark(compared: Page, scheme: str) -> None:
    """axe-core: `npm install axe-core`, NODE_PATH."""
    found = [Path(folder) / "axe-core" / "axe.min.js" for folder in os.environ.get("NODE_PATH", "").split(os.pathsep)]
    if not any(path.is_file() for path in found):
        pytest.skip("the npm package axe-core is not installed where Node looks (NODE_PATH)")
    compared.page.emulate_media(color_scheme=scheme)
    bright = compared.run("getComputedStyle(document.body).backgroundColor") == "rgb(244, 244, 242)"
    assert bright == (scheme == "light")
    compared.page.locator("#more").click()
    compared.page.locator("#about").click()
    compared.run(next(path for path in found if path.is_file()).read_text())
    violations = compared.run("axe.run().then((report) => report.violations)")
    assert [(v["id"], v["nodes"][0]["html"]) for v in violations if v["impact"] in ("serious", "critical")] == []


def test_names_with_markup_stay_text(new_page: Callable[[], Page], tmp_path: Path) -> None:
    page = new_page()
    asked: list[str] = []
    page.page.on("dialog", lambda dialog: (asked.append(dialog.message), dialog.dismiss()))
    write_page([make_scene(sharp_model("yang4d"), NASTY, CAMERAS)], tmp_path / "scene.html")
    page.open(tmp_path / "scene.html")
    page.run("d2.then((player) => player.count)")
    assert page.page.title() == NASTY
    assert page.page.locator("#name").inner_text() == NASTY
    assert page.page.locator("#camera optgroup:last-of-type option").all_text_contents()[0] == CAMERAS[0]
    assert page.page.locator("body b").count() == 0
    assert asked == []
    assert page.complaints == []


def test_a_page_whose_data_is_damaged_says_so(new_page: Callable[[], Page], tmp_path: Path) -> None:
    path = tmp_path / "scene.html"
    write_page([make_scene(sharp_model("yang4d"))], path)
    text = path.read_text()
    place = text.index('<script id="data"') + 60
    path.write_text(text[:place] + "AAAA" + text[place + 4 :])
    page = new_page().open(path)
    page.page.wait_for_function("!document.getElementById('message').textContent.startsWith('reading')")
    assert page.page.locator("#message").is_visible()


def test_what_the_page_says_of_itself_is_not_under_the_other_controls(compared: Page) -> None:
    compared.page.locator("#more").click()
    compared.page.locator("#about").click()
    assert compared.page.locator("#notes").is_visible()
    assert compared.page.locator("#rest").is_hidden()
    assert compared.page.locator("#about").get_attribute("aria-expanded") == "true"
    assert "12 recorded images of the cameras right" in compared.page.locator("#facts").inner_text()
