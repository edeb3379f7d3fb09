"""Videos of a run: every image at its rate, along any path, of any kind, and nothing left where one fails."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import refuses
from stand_in_recordings import Smooth
from viewing.export.scenes import psnr

from d2_plugin.durable import write_table
from d2_plugin.errors import D2Error, MissingExtra
from d2_plugin.recordings.images import read_image
from d2_plugin.runs.run import Run
from d2_plugin.runs.saved import RUN, save_checkpoint
from d2_plugin.runs.start import make_view
from d2_plugin.viewing.panels import KINDS, Shot
from d2_plugin.viewing.videos.plan import RenderSettings, plan_video
from d2_plugin.viewing.videos.render import run
from d2_plugin.viewing.videos.video import write_video
from d2_plugin.viewing.viewed import ViewedRun

av = pytest.importorskip("av", reason="PyAV is in the `video` extra")


def video_of(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


@pytest.fixture(scope="module")
def rendered(trained: Path) -> Callable[[str, int], np.ndarray]:
    """The backbone's own render at a camera of the recording, through the rasterizer, [H, W, 3] in 0..1."""
    opened = Run.load(trained)
    model, recording = opened.trained().model, opened.scene.recording

    def at(camera: str, frame: int) -> np.ndarray:
        with torch.no_grad():
            return model.render(make_view(recording, camera, frame)).color.clamp(0, 1).numpy()

    return at


def test_a_held_out_camera_plays_the_whole_recording_as_the_rasterizer_draws_it(trained, tmp_path, rendered) -> None:
    assert "4 images of 96x54, 12 per second" in run(RenderSettings((trained,), output=tmp_path / "a.mp4", quality=10))
    found = video_of(tmp_path / "a.mp4")
    assert len(found) == 4
    assert found[0].shape == (54, 96, 3)
    grey = [frame.mean(-1) / 255 for frame in found]  # a video keeps colours at half the size
    assert psnr(grey[0], rendered("test0", 0).mean(-1)) >= 35
    assert psnr(grey[-1], rendered("test0", 3).mean(-1)) >= 35
    assert psnr(grey[0], rendered("train0", 0).mean(-1)) < 30, "another camera is another image"


def test_an_orbit_has_the_asked_length_rate_and_odd_size(trained: Path, tmp_path: Path) -> None:
    size = {"seconds": 0.5, "fps": 20, "width": 63, "height": 35, "speed": 0.25}
    assert "the file has 64x36" in run(RenderSettings((trained,), output=tmp_path / "a.mp4", path="orbit", **size))
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height, stream.frames, stream.average_rate) == (64, 36, 10, 20)


def test_a_camera_path_of_nerfstudio_is_followed(trained, tmp_path, viewed, rendered) -> None:
    camera = viewed.recording.cameras["train1"]
    opengl = np.linalg.inv(camera.T_camera_world) @ np.diag([1.0, -1, -1, 1])
    fov = float(np.degrees(2 * np.arctan(camera.height / 2 / camera.K[1, 1])))
    entry = {"camera_to_world": opengl.flatten().tolist(), "fov": fov, "aspect": 16 / 9}
    path = tmp_path / "camera_path.json"
    entries = [entry | {"render_time": 0.0}, entry | {"render_time": 1.0}]
    path.write_text(json.dumps({"render_width": 96, "render_height": 54, "fps": 5, "camera_path": entries}))
    (tmp_path / "png").mkdir()
    for stale in ("00002.png", "00003.png", "mine.png"):  # of a longer video
        (tmp_path / "png" / stale).touch()
    run(RenderSettings((trained,), output=tmp_path / "png", path=str(path), format="png"))
    assert {file.name for file in (tmp_path / "png").iterdir()} == {"00000.png", "00001.png", "mine.png"}
    found = [read_image(tmp_path / "png" / name) for name in ("00000.png", "00001.png")]
    assert psnr(found[0] / 255, rendered("train1", 0)) > 45
    assert psnr(found[1] / 255, rendered("train1", 3)) > 45


def test_time_plays_bounces_slows_and_freezes(viewed: ViewedRun) -> None:
    def times(**settings: object) -> list[float]:
        return [round(12 * stop.time, 6) for stop in plan_video(viewed, RenderSettings((), **settings)).stops]

    assert times() == [0, 1, 2, 3]
    assert times(speed=0.5) == [0, 0.5, 1, 1.5, 2, 2.5, 3]
    assert times(seconds=8 / 12) == [0, 1, 2, 3, 2, 1, 0, 1]
    assert times(path="orbit", at=0.1, seconds=0.5) == [1.2] * 6
    nearest = times(speed=0.5, show=("truth",))
    assert {*nearest} == {0, 1, 2, 3}
    assert max(abs(time - 0.5 * i) for i, time in enumerate(nearest)) <= 0.5
    late = replace(viewed.recording, late={"test0": {1: 0.02, 3: 0.05}})
    shown = plan_video(replace(viewed, recording=late), RenderSettings((), show=("truth",))).stops
    assert [stop.time for stop in shown] == pytest.approx([late.seconds(frame, "test0") for frame in late.frames])
    assert len(times(path="training")) == 3 * 4
    refuses("lies outside the recording, which lasts 0.25 s", plan_video, viewed, RenderSettings((), at=3.0))


@pytest.mark.parametrize("settings", [{"seconds": 1e6}, {"speed": 1e-6}])
def test_a_video_without_end_is_refused_before_it_is_laid_out(viewed: ViewedRun, settings: dict) -> None:
    refuses("images, at most 1000000: choose fewer --seconds", plan_video, viewed, RenderSettings((), **settings))


def test_images_that_memory_does_not_hold_are_refused(trained: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("d2_plugin.recordings.checks.memory.available_bytes", lambda: 2**30)
    with pytest.raises(D2Error, match=r"images of 16384x9216 pixels need about 14.1 GiB .* smaller --width"):
        run(RenderSettings(runs=(trained,), output=tmp_path / "a.mp4", width=16384))
    assert not list(tmp_path.iterdir())


def test_every_kind_of_image_stands_beside_the_others_and_runs_below(trained: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    shutil.copytree(trained, again)
    show = tuple(KINDS)
    which = {"path": "training", "cameras": ("train1",), "show": show, "seconds": 0.1}
    run(RenderSettings((trained, again), output=tmp_path / "a.mp4", **which))
    [image] = video_of(tmp_path / "a.mp4")
    assert image.shape == (2 * (54 + 20) + 4, len(show) * 96 + (len(show) - 1) * 4, 3)
    assert min(panel.std() for panel in np.array_split(image[24:74], len(show), axis=1)) > 3, "no panel is empty"


def test_panels_show_what_they_say(viewed: ViewedRun) -> None:
    shot = Shot(viewed, viewed.view(viewed.recording.cameras["train1"], 0.0), (1.0, 9.0))
    assert np.array_equal(KINDS["truth"](shot).image, viewed.recording.image("train1", 0))
    difference = np.abs(shot.rendered.color.numpy() - viewed.recording.image("train1", 0) / np.float32(255))
    assert f"{-10 * np.log10(np.mean(difference**2)):.1f} dB" in KINDS["error"](shot).caption
    depth = KINDS["true-depth"](shot)
    assert "1..9" in depth.caption
    assert depth.bar is not None


def test_what_cannot_be_shown_is_one_sentence(trained: Path, room: Path, tmp_path: Path, refused) -> None:
    assert "holds no run" in refused("render", tmp_path)
    assert "no run at" in refused("render", tmp_path / "none")
    assert "d2 render needs RUN" in refused("render")
    for more in (["--recording", room], ["--train-cameras", "train0"], ["--downscale", "2"]):
        assert "is a folder of a run, which knows its recording" in refused("render", trained, *more)
    assert "did you mean 'orbit'?" in refused("render", trained, "--path", "orbti")
    assert "did you mean 'depth'?" in refused("render", trained, "--show", "rgb,deph")
    assert "train1 is a training one: choose --path training" in refused("render", trained, "--cameras", "train1")
    assert "did you mean 'test0'?" in refused("render", trained, "--cameras", "test")
    assert "at the recording's cameras only" in refused("render", trained, "--path", "orbit", "--show", "error")


@pytest.mark.parametrize("command", ["render", "view", "export"])
def test_a_run_of_which_nothing_is_left_or_known_is_one_sentence(trained, tmp_path, refused, command) -> None:
    folder = shutil.copytree(trained, tmp_path / "run")
    state = torch.load(folder / "checkpoint.pt", weights_only=True)
    parts = {name: {key: row[:0] for key, row in state["model"][name].items()} for name in ("parameters", "statistics")}
    state["model"] = parts | {"optimizer": state["model"]["optimizer"] | {"state": {}}}
    save_checkpoint(folder / "checkpoint.pt", state)
    assert "has no Gaussian left at step 40" in refused(command, folder)
    (folder / "checkpoint.pt").write_bytes((folder / "checkpoint.pt").read_bytes()[:1000])
    assert "is damaged" in refused(command, folder)
    (folder / "checkpoint.pt").unlink()
    assert "holds no checkpoint yet" in refused(command, folder)
    table = json.loads((folder / "run.json").read_text())
    plain = {name: value for name, value in table.items() if name not in ("format", "seal")}
    write_table(folder / "run.json", plain | {"version": 99}, RUN)
    assert "version 99" in refused(command, folder)


@pytest.mark.parametrize("command", ["render", "export"])
def test_a_run_that_still_trains_and_has_no_prior_is_shown_with_a_note(bare, tmp_path, answered, command) -> None:
    folder = shutil.copytree(bare, tmp_path / "<script>alert(1)<")
    save_checkpoint(folder / "checkpoint.pt", torch.load(folder / "checkpoint.pt", weights_only=True) | {"step": 1})
    said = answered(command, folder, "--output", tmp_path / "out.mp4")
    assert f"{folder.name} still trains: this is step 1 of 2" in said


def soft(count: int, width: int, height: int) -> list[np.ndarray]:
    """Smooth colours with a spot that moves."""
    return [Smooth(width, height).image("a", frame) for frame in range(count)]


def write(path: Path, images: list[np.ndarray], fps: float = 30, form: str = "mp4") -> None:
    with write_video(path, form, fps) as add:
        for image in images:
            add(image)


def test_every_image_comes_back_at_its_rate_odd_sides_gain_one_and_the_index_is_in_front(tmp_path: Path) -> None:
    images, path = soft(9, 63, 47), tmp_path / "video.mp4"
    write(path, images, 29.97)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert (stream.width, stream.height) == (64, 48)
        assert (stream.average_rate, stream.frames) == (Fraction(30000, 1001), 9)
        assert stream.duration * stream.time_base == Fraction(9 * 1001, 30000)
    found = video_of(path)
    assert len(found) == 9
    for image, given in zip(found, images, strict=True):
        assert psnr(image[:47, :63] / 255, given / 255) > 35
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat"), "a browser can begin before it has the whole file"


def test_an_animated_webp_keeps_number_and_odd_size(tmp_path: Path) -> None:
    path = tmp_path / "video.webp"
    write(path, soft(5, 61, 43), 10, "webp")
    data = path.read_bytes()  # ffmpeg decodes no animated WebP: its frames are counted in the file
    assert (data[:4], data[8:12], data.count(b"ANMF")) == (b"RIFF", b"WEBP", 5)
    at = data.index(b"VP8X") + 12
    assert [int.from_bytes(data[at + i : at + i + 3], "little") for i in (0, 3)] == [60, 42]


def test_a_video_that_fails_leaves_what_was_there_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "video.mp4"
    path.write_bytes(b"earlier")
    (tmp_path / ".0123.part").write_bytes(b"of a video that was killed")
    failures = {
        "32x32 pixels got": [*soft(1, 32, 32), *soft(1, 34, 32)],
        "without an image": [],
        r"cannot write the video .*\.mp4 \(.*\): choose other --width": [np.zeros((2, 20_000, 3), np.uint8)],
    }
    for says, images in failures.items():
        refuses(says, write, path, images)
        assert path.read_bytes() == b"earlier"
        assert [entry.name for entry in tmp_path.iterdir()] == ["video.mp4"]


def test_a_place_where_no_video_can_be_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "folder.mp4").mkdir()
    with pytest.raises(D2Error, match="a video of 100000 images per second cannot be: give --fps from 0.001 to 1000"):
        write(tmp_path / "a.mp4", soft(1, 32, 32), 1e5)
    for path in (tmp_path / "file" / "a.mp4", tmp_path / f"{'y' * 300}.mp4", tmp_path / "folder.mp4"):
        refuses("cannot write|is a file, expected a folder", write, path, soft(1, 32, 32))
    refuses("a video of format mp4 needs a name that ends so, got file", write, tmp_path / "file", soft(1, 32, 32))
    assert (tmp_path / "file").read_text() == "in the way"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "folder.mp4"]


def test_without_pyav_one_sentence_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    refuses(r"pip install 'd2-4dgs\[video\]'", write, tmp_path / "a.mp4", [], error=MissingExtra)
