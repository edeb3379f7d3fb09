"""Which camera and frame of the prior store a trainer's camera object stands for.

What stays the same between runs differs by repository: the image's name or path where the camera object carries one,
never `uid` or `colmap_id`, which are positions in a list that some of them shuffle (scene/__init__.py:69 of
fudan-zvg/4d-gaussian-splatting).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.protocol import View

from .shared import once_per_camera


class PriorKey(NamedTuple):
    """The name of a camera and the number of a frame, as the prior store has them."""

    camera: str
    frame: int


KeyOf = Callable[[Any], PriorKey]
"""From a trainer's camera object to the key of its prior; every adapter takes one as `key`."""

_PREFIXED = re.compile(r"(?P<camera>.+)_(?P<frame>\d+)$")
_TECHNICOLOR = re.compile(r"(?P<frame>\d+)_(?P<camera>\d+)$")
_NUMBER = re.compile(r"(\d+)\D*$")
_NO_CAMERA = {"frame", "image", "img"}
_NO_FOLDER = {"", ".", "..", "/", "images"}


def key_from_image_name(name: str) -> PriorKey:
    """The key in the name or path of an image: cam01_0003(.png), cam01/0003.png or cam01/images/frame_00003.png.

    Raises:
        D2Error: the name has no camera or no frame in it.
    """
    path, stem = PurePosixPath(name.replace("\\", "/")), _stem(name)
    match = _PREFIXED.match(stem)
    if match and match["camera"].lower() not in _NO_CAMERA:
        return PriorKey(match["camera"], int(match["frame"]))
    folders = [folder for folder in path.parts[:-1] if folder not in _NO_FOLDER]
    number = _NUMBER.search(stem)
    if folders and number:
        return PriorKey(folders[-1], int(number[1]))
    raise D2Error(
        f"image '{name}' does not say its camera and frame: name it CAMERA_FRAME or CAMERA/FRAME, or give the "
        "adapter a function `key` that returns PriorKey(camera, frame) for a camera object"
    )


def key_of_technicolor(name: str) -> PriorKey:
    """The key in a name of the Technicolor recordings, SCENE_undist_FRAME_CAMERA.png, where the camera comes last.

    Cameras are called 00 to 15, as in the prior of such a folder.

    Raises:
        D2Error: the name does not end in two numbers.
    """
    match = _TECHNICOLOR.search(_stem(name))
    if match is None:
        raise D2Error(f"image '{name}' does not end in FRAME_CAMERA as those of Technicolor do: give another `key`")
    return PriorKey(f"{int(match['camera']):02d}", int(match["frame"]))


def one_image_each(camera: Any) -> PriorKey:
    """The key of a recording by one moving camera, where every image is a camera of its own at frame 0."""
    return PriorKey(PurePosixPath(str(camera.image_name)).stem, 0)


def _stem(name: str) -> str:
    path = PurePosixPath(name.replace("\\", "/"))
    return path.stem if path.suffix and not path.suffix[1:].isdigit() else path.name


def frame_of_time(time: float, frames: float, first: int = 0) -> int:
    """The number of the frame at `time` where `frames` of them make one unit of time.

    Raises:
        D2Error: the time lies a quarter of a frame or more away from the nearest frame.
    """
    frame = round(time * frames)
    if abs(time * frames - frame) > 0.25:
        raise D2Error(
            f"time {time:g} is frame {time * frames:.2f} of {frames:g}, not a whole one: give the adapter the number "
            "of frames that the trainer divides by"
        )
    return first + frame


class KeysByPose:
    """Keys for camera objects that say nothing but where they stand: the known camera nearest in pose.

    `cameras` maps the names in the prior store to T_camera_world [4, 4] in the trainer's world; `frame` gives the
    frame of a camera object, for instance from its time. A camera that stands nowhere near a known one is refused.
    """

    def __init__(self, cameras: Mapping[str, Tensor], frame: Callable[[Any], int], tolerance: float = 1e-3) -> None:
        self.names, self.poses = list(cameras), torch.stack([torch.as_tensor(pose) for pose in cameras.values()])
        self.frame, self.tolerance = frame, tolerance
        self._name = once_per_camera("world_view_transform", self._nearest)

    def __call__(self, camera: Any) -> PriorKey:
        """The key of a camera object of the Inria family, at its present frame."""
        return PriorKey(self._name(camera), self.frame(camera))

    def _nearest(self, camera: Any) -> str:
        pose = camera.world_view_transform.detach().T
        distances = _distances(self.poses, pose)
        nearest = int(distances.argmin())
        if distances[nearest] > self.tolerance:
            raise D2Error(
                f"camera '{getattr(camera, 'image_name', camera)}' stands at none of the known poses (the nearest, "
                f"{self.names[nearest]}, differs by {float(distances[nearest]):.3g}): give poses in the trainer's world"
            )
        return self.names[nearest]


def _distances(poses: Tensor, pose: Tensor) -> Tensor:
    """How far poses [P, 4, 4] lie from one, in the world's unit per unit of distance, [P]; on the CPU."""
    pose = pose.cpu().double()
    return (poses.double().cpu() - pose).abs().flatten(1).amax(1) / max(1.0, float(pose.abs().max()))


class ViewsByPose:
    """Views of gsplat's data sets, whose items have no names: camera and frame are those of the image at that pose.

    Args:
        parser: `datasets.colmap.Parser` of gsplat's examples: `camtoworlds` [P, 4, 4] and `image_names`.
        key: from the name of an image to its key.
        tolerance: how far two poses may lie apart to be the same, in the world's unit per unit of distance.
    """

    def __init__(
        self, parser: Any, key: Callable[[str], PriorKey] = key_from_image_name, tolerance: float = 1e-4
    ) -> None:
        self.poses = torch.as_tensor(parser.camtoworlds)
        self.keys, self.tolerance = [key(name) for name in parser.image_names], tolerance

    def __call__(self, item: Any) -> View:
        """The view of an item or a batch of one: camtoworld [4, 4], K [3, 3], and image [H, W, 3] or width and height.

        Raises:
            D2Error: no image has that pose, or several have.
        """
        pose, K = item["camtoworld"].detach().reshape(4, 4), item["K"].detach().reshape(3, 3)
        height, width = item["image"].shape[-3:-1] if "image" in item else (item["height"], item["width"])
        near = torch.nonzero(_distances(self.poses, pose) < self.tolerance).squeeze(-1)
        if len(near) != 1:
            raise D2Error(
                f"{len(near)} images have the pose of this view: gsplat's images are known by their poses, so give "
                "it one instant of the recording (`d2 export-recording --format gsplat`), and no pose_opt or pose_noise"
            )
        key = self.keys[int(near)]
        return View(key.camera, key.frame, 0.0, torch.linalg.inv_ex(pose).inverse, K, int(width), int(height))
