"""The viewer without a browser: training stays bitwise what it is, images keep to their share, names stay names."""

import copy
import math
from collections.abc import Callable
from contextlib import closing, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.error import HTTPError
from urllib.request import urlopen

import numpy as np
import pytest
import torch
from tiny import ALL_HOOKS, make_trainer, parameters, same

from d2_plugin.errors import MissingExtra
from d2_plugin.recordings.cameras.rotations import quaternion_of_rotation
from d2_plugin.viewing.live import Viewer
from d2_plugin.viewing.live.images import Resolution, draw
from d2_plugin.viewing.live.overlay import cloud_of
from d2_plugin.viewing.live.page import Page, Wanted
from d2_plugin.viewing.live.server import COOKIE, Access
from d2_plugin.viewing.live.show import ViewSettings, address_line, viewed_at
from d2_plugin.viewing.live.viewer import MOVED, WATCHED
from d2_plugin.viewing.videos.plan import RenderSettings, plan_video
from d2_plugin.viewing.viewed import ViewedRun

pytest.importorskip("viser", reason="viser is in the `view` extra")
from refusals import refuses
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect


class Gui:
    """Controls that remember, in the place of a browser's."""

    def __getattr__(self, name: str) -> Any:
        def add(label: str, *values: Any, **named: Any) -> Any:
            given = {"add_slider": 3, "add_checkbox": 0, "add_text": 0}.get(name)
            value = named.get("initial_value", values[given] if given is not None else None)
            handle = SimpleNamespace(value=value, label=label)
            if name == "add_slider":
                handle.min, handle.max = values[:2]
            if name == "add_dropdown":
                handle.options = values[0]
            handle.on_update = handle.on_click = lambda react: setattr(handle, "react", react)
            return nullcontext() if name == "add_folder" else handle

        return add


class Scene:
    def __init__(self) -> None:
        self.images: list[np.ndarray | None] = []

    def set_background_image(self, image: np.ndarray | None, **_: Any) -> None:
        self.images.append(image)

    def __getattr__(self, name: str) -> Any:
        nothing = {"on_click": lambda react: None, "remove": lambda: None}
        return lambda *_, **named: SimpleNamespace(visible=True, **nothing, **named)


def looker() -> Any:
    """A client that stands still three units before the plane of the tiny scene."""
    place = {"position": np.zeros(3), "wxyz": np.array([1.0, 0, 0, 0]), "fov": 0.8, "aspect": 4 / 3}
    camera = SimpleNamespace(**place, image_height=48, update_timestamp=1.0)
    camera.on_update = lambda react: None
    return SimpleNamespace(client_id=1, gui=Gui(), scene=Scene(), camera=camera, atomic=nullcontext)


def built(viewed: ViewedRun, client: Any = None) -> Page:
    page = Page(client or looker(), viewed, None, 54, lambda: None)
    page.build()
    return page


PORT = 18190


def test_one_line_shows_any_trainer_and_training_stays_bitwise_the_same() -> None:
    alone, watched = make_trainer(ALL_HOOKS), make_trainer(ALL_HOOKS)
    alone.run()
    state = torch.random.get_rng_state()
    client = looker()
    with closing(Viewer(watched.d2, port=PORT, height=48)) as viewer:
        viewer._connected(client)
        watched.run()
        assert len(client.scene.images) >= 1
        assert client.scene.images[-1].std() > 5
        assert set(viewer.viewed.recording.cameras) == {"cam0", "cam1", "cam2"}
        assert viewer.viewed.duration == 0.5
    assert same(parameters(alone), parameters(watched))
    assert torch.equal(state, torch.random.get_rng_state())
    assert watched.d2.step.__func__ is type(watched.d2).step, "closed, it lets go of the trainer"


@pytest.mark.parametrize(("seconds", "moves"), [(0.001, False), (0.1, False), (0.02, True)])
def test_images_take_a_twentieth_of_the_time_of_a_training_and_more_for_who_moves(
    viewed: ViewedRun, monkeypatch: pytest.MonkeyPatch, seconds: float, moves: bool
) -> None:
    """Images of so many seconds each, in a thousand steps of a hundredth of a second."""
    clock, client, drawn = SimpleNamespace(now=0.0), looker(), []
    clock.monotonic = lambda: clock.now
    monkeypatch.setattr("d2_plugin.viewing.live.viewer.time", clock)

    def draw(*_: object) -> None:
        clock.now += seconds
        drawn.append(seconds)

    with closing(Viewer(viewed=viewed, port=PORT, height=48, iterations=1000)) as viewer:
        monkeypatch.setattr("d2_plugin.viewing.live.viewer.draw", draw)
        viewer._connected(client)
        for step in range(1000):
            clock.now += 0.01
            client.camera.position = np.full(3, step * moves)
            viewer.after_step(step)
    assert len(drawn) > 1
    least, most = (2 * WATCHED, 1.1 * MOVED) if moves else (0.5 * WATCHED, 1.1 * WATCHED + seconds / 10)
    assert least < sum(drawn) / clock.now < most


def test_d2_knows_which_gaussians_it_inserted_across_all_edits_and_a_resume() -> None:
    trainer = make_trainer(ALL_HOOKS)
    trainer.run(12)
    marks = trainer.d2.inserted_at
    assert len(marks) == len(trainer.model)
    assert set(marks.unique().tolist()) <= {0, 5, 10}
    assert 0 < int((marks > 0).sum()) <= sum(entry.count for entry in trainer.d2.trace if entry.action == "insert")
    resumed = make_trainer(ALL_HOOKS)
    resumed.load_state_dict(copy.deepcopy(trainer.state_dict()))
    assert torch.equal(resumed.d2.inserted_at, marks)
    trainer.run()
    resumed.run()
    assert torch.equal(resumed.d2.inserted_at, trainer.d2.inserted_at)
    assert len(trainer.d2.inserted_at) == len(trainer.model)


@pytest.mark.parametrize(
    ("fixed", "pixel", "heights"), [(0.0, 1e-6, (150, 240)), (0.15, 1e-7, (300, 361))], ids=["pixels", "Gaussians"]
)
def test_a_moving_image_is_as_large_as_fits_its_time(fixed: float, pixel: float, heights: tuple[int, int]) -> None:
    """What Gaussians cost before the first pixel does not get less with fewer pixels."""
    resolution = Resolution()
    for _ in range(40):
        width, height = resolution.size(16 / 9, 360, 0.06)
        resolution.drew(width * height, fixed + pixel * width * height)
        assert resolution.size(16 / 9, 360) == (640, 360), "at rest it is whole"
        resolution.drew(640 * 360, fixed + pixel * 640 * 360)
    assert heights[0] < height < heights[1]
    assert width == round(height * 16 / 9)
    for _ in range(40):
        resolution.drew(1000, 60.0)
    assert resolution.size(1.0, 360, 0.06) == (72, 72)


def test_the_browsers_camera_becomes_the_view_of_the_same_camera(viewed: ViewedRun) -> None:
    camera = viewed.recording.cameras["train1"]
    q = quaternion_of_rotation(camera.T_camera_world[:3, :3].T)
    fov = 2 * np.arctan(camera.height / 2 / camera.K[1, 1])
    seen = Wanted((*camera.centre, *q, fov), 96 / 54, 0.0, "rgb", 0.0, False, 54).camera(96, 54)
    assert np.allclose(seen.T_camera_world, camera.T_camera_world, atol=1e-9)
    assert np.allclose(np.diag(seen.K), np.diag(camera.K), rtol=1e-6)


def test_at_a_camera_the_recorded_image_and_the_error_are_shown_and_elsewhere_not(viewed: ViewedRun) -> None:
    client = looker()
    page = built(viewed, client)
    page.stand_at("train1")
    page.controls["recorded"].value = 1.0
    wanted, _ = page.wanted(0.0)
    assert wanted.standing == "train1"
    truth = viewed.recording.image("train1", 0)
    draw(page, wanted, None, None, Resolution())
    image = client.scene.images[-1]  # 4:3 of a window, from the middle of 16:9
    assert np.array_equal(image, truth[:, 12:-12])
    page.controls["recorded"].value, page.controls["show"].value = 0.0, "error"
    draw(page, page.wanted(0.0)[0], None, None, Resolution())
    assert not np.array_equal(client.scene.images[-1], image)
    client.camera.position = client.camera.position + 0.1
    wanted, _ = page.wanted(0.0)
    assert (wanted.standing, wanted.show, wanted.recorded) == (None, "rgb", 0.0)


def test_keyframes_become_a_path_that_d2_render_follows(viewed: ViewedRun, tmp_path: Path) -> None:
    client, sent = looker(), []
    client.send_file_download = lambda name, content, save_immediately: sent.append((name, content))
    page = built(viewed, client)
    page._save()
    assert not sent, "without a keyframe there is no path"
    for name, time in (("train0", 0.0), ("train2", viewed.duration)):
        page.stand_at(name)
        page.controls["time"].value = time
        page.wanted(0.0)
        page._keep(1)
    page._keep(1)
    page._keep(-1)
    page.controls["path_seconds"].value = 0.5
    page._save()
    [(name, content)] = sent
    (tmp_path / name).write_bytes(content)
    plan = plan_video(viewed, RenderSettings((), path=str(tmp_path / name)))
    assert len(plan.stops) / plan.fps == pytest.approx(0.5)
    ends = [plan.stops[0], plan.stops[-1]]
    for stop, camera, time in zip(ends, ("train0", "train2"), (0.0, viewed.duration), strict=True):
        assert np.allclose(stop.camera.T_camera_world, viewed.recording.cameras[camera].T_camera_world, atol=1e-6)
        assert stop.time == pytest.approx(time)


def test_the_prior_as_points_lies_where_its_pixels_say(viewed: ViewedRun) -> None:
    positions, _ = cloud_of(viewed, 0, "label", most=500)
    assert 50 < len(positions) <= 700
    assert np.isfinite(positions).all()
    exact = viewed.recording.depth("train0", 0)
    camera = viewed.recording.cameras["train0"]
    seen = positions @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]
    pixels = (seen @ camera.K.T)[:, :2] / seen[:, 2:]
    inside = (seen[:, 2] > 0) & (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
    truth = exact[tuple(np.floor(pixels[inside]).astype(int).T[::-1])]
    assert np.median(np.abs(seen[inside, 2] / truth - 1)) < 0.1


def test_play_goes_on_with_the_clock_and_begins_again(viewed: ViewedRun) -> None:
    page = built(viewed)
    page.controls["play"].value = True
    page.play(10.0)
    page.play(10.1)
    assert page.controls["time"].value == pytest.approx(0.1)
    page.controls["speed"].value = "0.5"
    page.play(10.2)
    assert page.controls["time"].value == pytest.approx(0.15)
    page.play(10.7)
    assert page.controls["time"].value == pytest.approx((0.15 + 0.25) % (0.25 + 1 / 12))


def damaged(client: Any, page: Page) -> list[Callable[[], object]]:
    """Messages that no page sends, as viser hands them on."""

    def camera(**values: Any) -> Callable[[], object]:
        return lambda: vars(client.camera).update(values)

    def control(name: str, value: Any) -> Callable[[], object]:
        return lambda: setattr(page.controls[name], "value", value)

    nan = math.nan
    return [
        *(camera(fov=fov) for fov in (0, 0.0, nan, math.pi, -1.0, 1e-300, "abc", None)),
        *(camera(wxyz=wxyz) for wxyz in (np.zeros(4), np.full(4, nan), np.ones(3), np.array(["a"] * 4), None)),
        *(camera(position=position) for position in (np.zeros(2), np.full(3, nan), np.full(3, 1e300), "abc")),
        *(camera(aspect=aspect) for aspect in (1e9, 0.0, nan, -1.0, "abc")),
        *(control("height", height) for height in (0, -5, 10**6, nan, "abc", None, True)),
        *(control("time", time) for time in (nan, math.inf, 1e300, "abc", [])),
        *(control(name, word) for name in ("show", "speed", "cloud", "camera") for word in ("abc", None, 5, [], {})),
        *(control(name, value) for name in ("play", "marked", "frusta") for value in ("abc", nan, None)),
        *(control(name, value) for name in ("recorded", "path_seconds") for value in (nan, "abc", -1, 1e300)),
    ]


def test_nothing_that_a_client_sends_stops_a_run_or_its_page(viewed: ViewedRun) -> None:
    client = looker()
    plain = dict(vars(client.camera))
    with closing(Viewer(viewed=viewed, port=PORT, height=48, iterations=10**6)) as viewer:
        viewer._connected(client)
        viewer.after_step(1)
        [(page, _)] = viewer._pages.values()
        values = {name: control.value for name, control in page.controls.items() if hasattr(control, "value")}
        for step, send in enumerate(damaged(client, page), start=2):
            send()
            page.stand_at(page.controls["camera"].value)
            viewer._draw_all()
            viewer.after_step(step)
            assert viewer.clients == 1, "its page is still drawn"
            vars(client.camera).update(plain)
            for name, value in values.items():
                page.controls[name].value = value
        assert max(image.shape[0] for image in client.scene.images if image is not None) <= 720


def test_a_page_that_fails_is_given_up_and_the_training_goes_on(viewed: ViewedRun, monkeypatch, caplog) -> None:
    monkeypatch.setattr("d2_plugin.viewing.live.viewer.draw", lambda *_: 1 / 0)
    with closing(Viewer(viewed=viewed, port=PORT, height=48, iterations=10)) as viewer:
        viewer._connected(looker())
        viewer.after_step(1)
        assert viewer.clients == 0
        assert "ZeroDivisionError" in caplog.text
        viewer.after_step(2)


class TestAccess:
    """Who has the printed address, and nobody else, and only from the page itself."""

    def test_a_request_is_answered_by_its_host_origin_and_token(self) -> None:
        local, everywhere = Access("127.0.0.1", "secret"), Access("0.0.0.0", "secret")
        cookie = {"Cookie": f"a=b; {COOKIE}=secret"}
        assert not local.problem("/?token=secret", Headers(Host="localhost:8080"))
        assert not local.problem("/", Headers(Host="127.0.0.1:9999", Origin="http://127.0.0.1:9999", **cookie))
        assert not everywhere.problem("/", Headers(Host="server:8080", Origin="http://server:8080", **cookie))
        assert "its own machine only" in local.problem("/?token=secret", Headers(Host="evil.example:8080"))
        assert "its own machine only" in local.problem("/?token=secret", Headers())
        for origin in ("http://evil.example", "null", "http://localhost:1"):
            assert "another page" in local.problem("/", Headers(Host="localhost:8080", Origin=origin, **cookie))
        for path, headers in (("/", {}), ("/?token=other", {}), ("/?token=", {"Cookie": f"{COOKIE}=secre"})):
            for access in (local, everywhere):
                assert "open the whole address" in access.problem(path, Headers(Host="localhost:8080", **headers))

    def test_the_server_asks_for_it(self, viewed: ViewedRun) -> None:
        with closing(Viewer(viewed=viewed, port=PORT)) as viewer:
            assert address_line(viewer, "127.0.0.1").endswith("(Ctrl-C ends)")
            assert "everybody who has this address" in address_line(viewer, "0.0.0.0")
            address, _, token = viewer.url.partition("/?token=")
            with pytest.raises(HTTPError, match="403") as refused:
                urlopen(address)
            refused.value.close()
            with urlopen(viewer.url) as answer:
                assert f"{COOKIE}={token}; HttpOnly; SameSite=Strict" in answer.headers["Set-Cookie"]
            socket = address.replace("http", "ws")
            with pytest.raises(InvalidStatus, match="403"):
                connect(socket)
            connect(socket, origin=address, additional_headers={"Cookie": f"{COOKIE}={token}"}).close()


class TestSentences:
    def test_what_cannot_be_shown(self, room: Path, tmp_path: Path, refused) -> None:
        assert "is empty: give the folder of a run" in refused("view", tmp_path)
        assert "no such recording" in refused("view", tmp_path / "none")
        (tmp_path / "store.json").write_text('{"format": 1}')
        assert "lies in no folder of a run: name its recording" in refused("view", tmp_path)
        assert "has format 1 but this" in refused("view", tmp_path, "--recording", room)

    def test_a_run_without_a_prior_has_no_points_to_show(self, bare: Path) -> None:
        found = viewed_at(ViewSettings(bare))
        assert found.store is None
        controls = set(built(found).controls)
        assert {"time", "show", "recorded", "marked"} <= controls
        assert not {"cloud", "pause"} & controls

    def test_a_prior_of_another_recording(self, trained: Path, room: Path) -> None:
        found = viewed_at(ViewSettings(trained / "priors", recording=room))
        assert found.train_cameras == ("train0", "train1", "train2")
        assert found.backbone is None
        page = built(found)
        assert "show" not in page.controls
        assert page.word("cloud", "") == "image"
        small = ViewSettings(trained / "priors", recording=room, downscale=2)
        refuses("pixels there and .* here.*--downscale", viewed_at, small)
        alone = viewed_at(ViewSettings(trained / "priors"))
        assert np.array_equal(alone.recording.image("train0", 0), found.recording.image("train0", 0))

    @pytest.mark.parametrize("host", ["192.0.2.1", "no such host", "a" * 300, "\u200b.."])
    def test_an_address_that_is_not_ours(self, viewed: ViewedRun, host: str) -> None:
        refuses(r"nothing can listen at .*: give an address of this machine", Viewer, viewed=viewed, host=host)

    def test_nothing_to_show_and_no_viser(self, viewed: ViewedRun, monkeypatch: pytest.MonkeyPatch) -> None:
        refuses("needs something to show", Viewer)
        monkeypatch.setitem(__import__("sys").modules, "viser", None)
        refuses(r"pip install 'd2-4dgs\[view\]'", Viewer, viewed=viewed, error=MissingExtra)


def test_d2_train_says_where_to_watch_and_ends_where_nobody_looks(room: Path, bare: Path, tmp_path, answered) -> None:
    words = ["train", str(room), "--train-cameras", "train0,train1", "--iterations", "2", "--hooks", "none", "--view"]
    assert "watch it train at http://localhost:" in answered(*words, "--output", str(tmp_path / "run"))
    ends = [torch.load(folder / "checkpoint.pt", weights_only=True)["model"] for folder in (tmp_path / "run", bare)]
    assert same(ends[0]["parameters"], ends[1]["parameters"]), "a watched run is bitwise the one that is not"
