"""One browser's page: its controls, what it lays over the image, and the image that it wants next.

viser calls back from threads of its own; they only set plain values here. Everything is drawn by the thread that calls
`Viewer`, so that no image is taken of Gaussians that change.

Names come from folders and files of others. They go into text fields and menus only, which show any text as it is;
never into Markdown or HTML.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from d2_plugin.recordings.cameras.rotations import quaternion_of_rotation, rotation_of_quaternion
from d2_plugin.viewing.paths import Lens, Pose
from d2_plugin.viewing.subject import Subject

REST = 0.3
"""Seconds without a change after which an image is drawn at its full size."""
SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0)
IMAGES = {"image": "rgb", "depth": "depth", "opacity": "alpha", "number of Gaussians": "count"}
"""What the menu says -> the kind of image."""
NO_IMAGE = "nothing"
CLOUDS = ("none", "label", "sigma", "image")
FREE = "free"


class Wanted(NamedTuple):
    """An image that a page wants."""

    pose: tuple[float, ...]  # position xyz, quaternion wxyz (camera to world), vertical field of view
    aspect: float
    time: float
    show: str
    min_opacity: float
    marked: bool
    height: int

    def camera(self, width: int, height: int) -> Pose:
        """Where the browser's camera stands, with the lens of an image of this size."""
        R = rotation_of_quaternion(np.array(self.pose[3:7])).T
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, -R @ np.array(self.pose[:3])
        focal = 0.5 * height / math.tan(self.pose[7] / 2)
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        return Pose(T, Lens(K, width, height))


@dataclass
class Training:
    """What all pages show of a training."""

    total: int | None = None
    said: str = "starting"
    scores: str = ""
    paused: bool = False


@dataclass
class Page:
    """The controls of one client."""

    client: Any
    subject: Subject
    training: Training | None
    most_height: int
    wake: Callable[[], None]
    controls: dict[str, Any] = field(default_factory=dict)
    changed_at: float = 0.0
    drawn: tuple[Wanted, int, bool] | None = None
    _last: Wanted | None = None
    _played_at: float | None = None

    def build(self) -> None:
        """Lay out the controls; what the subject does not have is left out."""
        gui, subject = self.client.gui, self.subject
        self._text("shown", "shown", subject.name)
        if subject.note:
            self._text("note", "note", subject.note)
        if self.training is not None:
            self._training_controls()
        if subject.duration > 0:
            with gui.add_folder("Time"):
                self._time_controls()
        if subject.backbone is not None:
            with gui.add_folder("Image"):
                self._image_controls()
        with gui.add_folder("Recording"):
            self._recording_controls()
        if subject.backbone is not None:
            self._text("size", "image size", "")
        for control in self.controls.values():
            if hasattr(control, "on_update"):
                control.on_update(lambda _: self.wake())
        self.client.camera.on_update(lambda _: self.wake())

    def _training_controls(self) -> None:
        gui = self.client.gui
        with gui.add_folder("Training"):
            self._text("progress", "step", "")
            self._text("scores", "score", "")
            button = gui.add_button("Pause" if not self._paused else "Go on")
            button.on_click(lambda _: self._toggle_pause())
            self.controls["pause"] = button

    def _time_controls(self) -> None:
        gui, subject = self.client.gui, self.subject
        step = 10.0 ** math.floor(math.log10(subject.duration / 100))
        most = round(math.floor(subject.duration / step + 1e-6) * step, 9)
        self.controls["time"] = gui.add_slider("seconds", 0.0, most, step, 0.0)
        self._text("frame", "frame", str(subject.recording.frames[0]))
        self.controls["play"] = gui.add_checkbox("play", False)
        self.controls["speed"] = gui.add_dropdown("speed", [f"{speed:g}" for speed in SPEEDS], initial_value="1")

    def _image_controls(self) -> None:
        gui, known = self.client.gui, self.subject.inserted_at is not None
        self.controls["show"] = gui.add_dropdown("show", [*IMAGES, NO_IMAGE], initial_value="image")
        self.controls["opacity"] = gui.add_slider("opacity from", 0.0, 0.95, 0.05, 0.0)
        self.controls["marked"] = gui.add_checkbox("inserted by D2 in orange", False, disabled=not known)
        low = min(90, self.most_height)
        self.controls["height"] = gui.add_slider("height", low, max(self.most_height * 2, 720), 1, self.most_height)

    def _recording_controls(self) -> None:
        gui, names = self.client.gui, tuple(self.subject.recording.cameras)
        self.controls["camera"] = gui.add_dropdown("stand at", [FREE, *names], initial_value=FREE)
        self.controls["camera"].on_update(lambda _: self.stand_at(self.controls["camera"].value))
        self.controls["frusta"] = gui.add_checkbox("cameras", True)
        self.controls["size_of_frusta"] = gui.add_slider("camera size", 0.1, 3.0, 0.1, 1.0)
        if self.subject.store is not None:
            self.controls["cloud"] = gui.add_dropdown("prior as points, by", CLOUDS, initial_value=self._first_cloud())
            self.controls["point_size"] = gui.add_slider("point size", 0.2, 5.0, 0.1, 1.0)

    def _first_cloud(self) -> str:
        return "none" if self.subject.backbone is not None else "image"

    def _text(self, name: str, label: str, value: str) -> None:
        self.controls[name] = self.client.gui.add_text(label, value, disabled=True)

    def value(self, name: str, default: Any = None) -> Any:
        """The value of a control, or the default where the page has none of that name."""
        return self.controls[name].value if name in self.controls else default

    def say(self, name: str, text: str) -> None:
        """Change a line of text."""
        if name in self.controls and self.controls[name].value != text:
            self.controls[name].value = text

    @property
    def _paused(self) -> bool:
        return self.training is not None and self.training.paused

    def _toggle_pause(self) -> None:
        if self.training is not None:
            self.training.paused = not self.training.paused
        self.wake()

    def tell_training(self) -> None:
        """Step, loss and score of a training, and what the button would do."""
        if self.training is None or "pause" not in self.controls:
            return
        self.say("progress", self.training.said)
        self.say("scores", self.training.scores)
        label = "Go on" if self.training.paused else "Pause"
        if self.controls["pause"].label != label:
            self.controls["pause"].label = label

    def stand_at(self, name: str) -> None:
        """Bring the browser's camera to one of the recording's."""
        camera = self.subject.recording.cameras.get(name)
        if camera is None:
            return
        T_world_camera = np.linalg.inv(camera.T_camera_world)
        with self.client.atomic():
            handle = self.client.camera
            handle.up_direction = -T_world_camera[:3, 1]
            handle.position = T_world_camera[:3, 3]
            handle.wxyz = quaternion_of_rotation(T_world_camera[:3, :3])
            handle.fov = 2 * math.atan(camera.height / 2 / camera.K[1, 1])
        self.wake()

    def play(self, now: float) -> None:
        """Move the slider on where the page plays; at the end it begins again."""
        if not self.value("play", False):
            self._played_at = None
            return
        if self._played_at is not None:
            passed = (now - self._played_at) * float(self.value("speed"))
            slider = self.controls["time"]
            end = self.subject.duration + 1 / self.subject.recording.fps
            time = (slider.value + passed) % end
            slider.value = float(min(time, slider.max))
        self._played_at = now

    def wanted(self, now: float) -> tuple[Wanted, bool] | None:
        """What the page wants, and whether something moves; None before the browser has said where its camera is."""
        camera = self.client.camera
        if camera.update_timestamp == 0.0 or camera.image_height == 0:
            return None
        pose = (*camera.position, *camera.wxyz, camera.fov)
        show = IMAGES.get(self.value("show", NO_IMAGE), "")
        wanted = Wanted(
            tuple(float(number) for number in pose),
            float(camera.aspect),
            float(self.value("time", 0.0)),
            show,
            float(self.value("opacity", 0.0)),
            bool(self.value("marked", False)),
            int(self.value("height", self.most_height)),
        )
        if wanted != self._last:
            self._last = wanted
            if self._played_at is None:
                self.changed_at = now
        moving = self._played_at is not None or now - self.changed_at < REST
        return wanted, moving
