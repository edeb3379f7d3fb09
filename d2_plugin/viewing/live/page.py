"""One browser's page: its controls, what it lays over the image, and the image that it wants next.

viser calls back from threads of its own; they only set plain values here, and the thread that calls `Viewer` draws.

A client may send anything: `Page` takes numbers within the ends of their sliders, words that stand in their menus and a
camera that can be one, and keeps what it had where a message is none of these. Names of folders and files go into text
fields and menus only, which show any text as it is, never into Markdown or HTML.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from d2_plugin.recordings import Camera
from d2_plugin.recordings.cameras.camera import FIELD_OF_VIEW, LARGEST_NUMBER, pinhole, rigid
from d2_plugin.recordings.cameras.rotations import quaternion_of_rotation, rotation_of_quaternion
from d2_plugin.viewing.camera_paths import between, camera_path_text
from d2_plugin.viewing.viewed import ViewedRun

REST = 0.3
"""Seconds without a change after which an image is drawn at its full size."""
WIDEST = 10.0
"""Of an image, relative to its height, or the other way round."""
SPEEDS = {f"{speed:g}": speed for speed in (0.1, 0.25, 0.5, 1.0, 2.0)}
IMAGES = {"image": "rgb", "error": "error", "depth": "depth", "opacity": "alpha"}
"""What the menu says -> the kind of image."""
AT_CAMERA = 1e-3
"""Of the numbers of a pose, relative to a camera's distance: who is so near stands at the camera."""
MOST_KEYFRAMES, PATH_SIZE = 100, (1280, 720)
"""Of a camera path, and the pixels of its images."""
PATH_RATE = 30.0
"""Images per second of a camera path."""
NO_IMAGE = "nothing"
CLOUDS = ("none", "label", "sigma", "image")
FREE = "free"


class Wanted(NamedTuple):
    """An image that a page wants."""

    pose: tuple[float, ...]  # position xyz, quaternion wxyz (camera to world), vertical field of view
    aspect: float
    time: float
    show: str
    marked: bool
    height: int
    standing: str | None = None
    """The camera of the recording at which the page stands."""
    recorded: float = 0.0
    """Share of the recorded image in the image there."""

    def camera(self, width: int, height: int) -> Camera:
        """The browser's camera for an image of this size."""
        R = rotation_of_quaternion(np.array(self.pose[3:7])).T
        focal = 0.5 * height / math.tan(self.pose[7] / 2)
        K = pinhole(focal, focal, width / 2, height / 2)
        return Camera("", width, height, K, rigid(R, -R @ np.array(self.pose[:3])))


@dataclass
class Training:
    """What all pages show of a training."""

    total: int | None = None
    progress: str = "starting"
    scores: str = ""
    paused: bool = False


@dataclass
class Page:
    """The controls of one client."""

    client: Any
    viewed: ViewedRun
    training: Training | None
    most_height: int
    wake: Callable[[], None]
    controls: dict[str, Any] = field(default_factory=dict)
    changed_at: float = 0.0
    drawn: tuple[Wanted, int, bool] | None = None
    keyframes: list[Wanted] = field(default_factory=list)
    """Of the camera path."""
    last: Wanted | None = None
    """What it wanted last."""
    _played_at: float | None = None
    _previewed: tuple[float, list[tuple[Camera, float]]] | None = None

    def build(self) -> None:
        """Lay out the controls; what the run does not have is left out."""
        gui, viewed, controls = self.client.gui, self.viewed, self.controls
        self._text("shown", "shown", viewed.name)
        if viewed.note:
            self._text("note", "note", viewed.note)
        if self.training is not None:
            with gui.add_folder("Training"):
                self._text("progress", "step")
                self._text("scores", "score")
                controls["pause"] = gui.add_button("Go on" if self.training.paused else "Pause")
                controls["pause"].on_click(lambda _: self._toggle_pause())
        if viewed.duration > 0:
            step = 10.0 ** math.floor(math.log10(viewed.duration / 100))
            most = round(math.floor(viewed.duration / step + 1e-6) * step, 9)
            with gui.add_folder("Time"):
                controls["time"] = gui.add_slider("seconds", 0.0, most, step, 0.0)
                self._text("frame", "frame", str(viewed.recording.frames[0]))
                controls["play"] = gui.add_checkbox("play", False)
                controls["speed"] = gui.add_dropdown("speed", list(SPEEDS), initial_value="1")
        if viewed.backbone is not None:
            known, height = viewed.inserted_at is not None, self.most_height
            with gui.add_folder("Image"):
                controls["show"] = gui.add_dropdown("show", [*IMAGES, NO_IMAGE], initial_value="image")
                controls["marked"] = gui.add_checkbox("inserted by D2 in orange", False, disabled=not known)
                controls["recorded"] = gui.add_slider("recorded over it", 0.0, 1.0, 0.05, 0.0)
                controls["height"] = gui.add_slider("height", min(90, height), max(height * 2, 720), 1, height)
        with gui.add_folder("Recording"):
            names = tuple(viewed.recording.cameras)
            controls["camera"] = gui.add_dropdown("stand at", [FREE, *names], initial_value=FREE)
            controls["camera"].on_update(lambda _: self.stand_at(controls["camera"].value))
            controls["frusta"] = gui.add_checkbox("cameras", True)
            if viewed.store is not None:
                first = "none" if viewed.backbone is not None else "image"
                controls["cloud"] = gui.add_dropdown("prior as points, by", CLOUDS, initial_value=first)
        if viewed.backbone is not None:
            self._text("size", "image size")
            with gui.add_folder("Camera path", expand_by_default=False):
                self._text("keyframes", "keyframes", "none")
                controls["path_seconds"] = gui.add_slider("seconds to the next", 0.2, 10.0, 0.1, 2.0)
                acts = {"Add keyframe": lambda _: self._keep(1), "Remove the last": lambda _: self._keep(-1)}
                acts |= {"Preview": lambda _: self._preview(), "Save camera_path.json": lambda _: self._save()}
                for label, act in acts.items():
                    gui.add_button(label).on_click(act)
        for control in controls.values():
            if hasattr(control, "on_update"):
                control.on_update(lambda _: self.wake())
        self.client.camera.on_update(lambda _: self.wake())

    def _text(self, name: str, label: str, value: str = "") -> None:
        self.controls[name] = self.client.gui.add_text(label, value, disabled=True)

    def number(self, name: str, default: float) -> float:
        """The number of a slider, within its ends; the default where there is no such slider or no number."""
        slider = self.controls.get(name)
        value = getattr(slider, "value", None)
        if slider is None or isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            return default
        return float(min(max(value, slider.min), slider.max))

    def word(self, name: str, default: str) -> str:
        """The word of a menu; the default where there is no such menu, or another word was sent."""
        menu = self.controls.get(name)
        return default if menu is None or menu.value not in tuple(menu.options) else str(menu.value)

    def ticked(self, name: str, default: bool = False) -> bool:
        """Whether a box is ticked; the default where there is none."""
        return self.controls[name].value is True if name in self.controls else default

    def _standing(self, pose: tuple[float, ...]) -> str | None:
        R = rotation_of_quaternion(np.array(pose[3:7])).T
        for name, camera in self.viewed.recording.cameras.items():
            near = AT_CAMERA * max(float(np.abs(camera.centre).max()), 1e-3)
            turned = np.abs(camera.T_camera_world[:3, :3] - R).max()
            if np.abs(camera.centre - pose[:3]).max() < near and turned < AT_CAMERA:
                return name
        return None

    def _keep(self, more: int) -> None:
        """Make the image that is seen a keyframe, or forget the last one."""
        if more > 0 and self.last is not None and len(self.keyframes) < MOST_KEYFRAMES:
            self.keyframes.append(self.last)
        elif more < 0:
            del self.keyframes[-1:]
        self.set_text("keyframes", str(len(self.keyframes) or "none"))

    def path(self) -> list[tuple[Camera, float]]:
        """The cameras from keyframe to keyframe, with their instants in seconds."""
        keys = tuple(self.keyframes)  # other threads of viser add and remove meanwhile
        chain = [key.camera(*PATH_SIZE) for key in keys]
        seconds = self.number("path_seconds", 2.0) * (len(chain) - 1)
        places = np.linspace(0, len(chain) - 1, max(round(seconds * PATH_RATE), 1)).tolist() if chain else []
        times = [float(np.interp(place, range(len(chain)), [key.time for key in keys])) for place in places]
        return [(between(chain, place), instant) for place, instant in zip(places, times)]

    def _save(self) -> None:
        if path := self.path():
            shares = [instant / max(self.viewed.duration, 1e-9) for _, instant in path]
            content = camera_path_text([camera for camera, _ in path], shares, PATH_RATE).encode()
            self.client.send_file_download("camera_path.json", content, save_immediately=True)

    def _preview(self) -> None:
        self._previewed = time.monotonic(), self.path()
        self.wake()

    def set_text(self, name: str, text: str) -> None:
        """Change a line of text."""
        if name in self.controls and self.controls[name].value != text:
            self.controls[name].value = text

    def _toggle_pause(self) -> None:
        if self.training is not None:
            self.training.paused = not self.training.paused
        self.wake()

    def show_training(self) -> None:
        """Step, loss and score of a training, and what the button would do."""
        if self.training is None or "pause" not in self.controls:
            return
        self.set_text("progress", self.training.progress)
        self.set_text("scores", self.training.scores)
        label = "Go on" if self.training.paused else "Pause"
        if self.controls["pause"].label != label:
            self.controls["pause"].label = label

    def stand_at(self, name: object) -> None:
        """Bring the browser's camera to one of the recording's."""
        camera = self.viewed.recording.cameras.get(name) if isinstance(name, str) else None
        if camera is not None:
            self._move_to(camera)

    def _move_to(self, camera: Camera) -> None:
        R = camera.T_camera_world[:3, :3]
        with self.client.atomic():
            handle = self.client.camera
            handle.up_direction = -R[1]
            handle.position = camera.centre
            handle.wxyz = quaternion_of_rotation(R.T)
            handle.fov = vertical_angle(camera)
        self.wake()

    def play(self, now: float) -> None:
        """Move the slider on where the page plays, or follow the camera path that it previews."""
        if self._previewed is not None:
            began, path = self._previewed
            place = int((now - began) * PATH_RATE)
            if place >= len(path):
                self._previewed = None
            else:
                self._move_to(path[place][0])
                if "time" in self.controls:
                    self.controls["time"].value = path[place][1]
        if not self.ticked("play"):
            self._played_at = None
            return
        if self._played_at is not None:
            passed = (now - self._played_at) * SPEEDS[self.word("speed", "1")]
            slider = self.controls["time"]
            end = self.viewed.duration + 1 / self.viewed.recording.fps
            slider.value = float(min((self.number("time", 0.0) + passed) % end, slider.max))
        self._played_at = now

    def wanted(self, now: float) -> tuple[Wanted, bool] | None:
        """What the page wants, and whether something moves; None before the browser has a camera that can be one."""
        seen = _seen_through(self.client.camera) or (None if self.last is None else self.last[:2])
        if seen is None:
            return None
        show = IMAGES.get(self.word("show", NO_IMAGE), "")
        instant, height = self.number("time", 0.0), self.number("height", self.most_height)
        at = self._standing(seen[0])
        recorded = self.number("recorded", 0.0) if at else 0.0
        if show == "error" and at is None:
            show = "rgb"
        wanted = Wanted(*seen, instant, show, self.ticked("marked"), int(height), at, recorded)
        if wanted != self.last:
            self.last = wanted
            if self._played_at is None:
                self.changed_at = now
        return wanted, self._played_at is not None or self._previewed is not None or now - self.changed_at < REST


def vertical_angle(camera: Camera) -> float:
    """The vertical field of view of a camera, radians, as if its principal point were in the middle."""
    return 2 * math.atan(camera.height / 2 / camera.K[1, 1])


def _seen_through(camera: Any) -> tuple[tuple[float, ...], float] | None:
    """Pose (see `Wanted`) and aspect of the browser's camera; None where it has sent none, or one that cannot be."""
    if camera.update_timestamp == 0.0:
        return None
    try:
        pose = tuple(float(number) for number in (*camera.position, *camera.wxyz, camera.fov))
        aspect = float(camera.aspect)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    fits = len(pose) == 8 and all(abs(number) <= LARGEST_NUMBER for number in pose)  # NaN is not
    fits = fits and 1 / WIDEST <= aspect <= WIDEST and abs(math.hypot(*pose[3:7]) - 1) < 0.1
    return (pose, aspect) if fits and FIELD_OF_VIEW[0] <= math.degrees(pose[7]) <= FIELD_OF_VIEW[1] else None
