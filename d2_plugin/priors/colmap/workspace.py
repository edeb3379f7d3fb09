"""Depth maps of COLMAP workspaces that the user has: `sparse/` with the cameras, `stereo/depth_maps/` with the maps.

A workspace holds pinhole images of its own, seldom the size or the intrinsics of ours, and often a world of its own
scale. So maps are looked up ray by ray, and depth is scaled by the ratio of the baselines, after the poses were checked
to be the same up to a similarity.
"""

from __future__ import annotations

import itertools
import logging
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import ClassVar

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.priors.geometry import relative_pose
from d2_plugin.priors.stereo.settings import StereoSettings
from d2_plugin.reading import read_bytes
from d2_plugin.recordings.cameras.camera import same_spot
from d2_plugin.recordings.cameras.formats.colmap import ColmapImage, ColmapModel, read_model
from d2_plugin.recordings.recording import Camera

PLACES = ("colmap/{frame:05d}", "colmap", "dense", "colmap/{frame:05d}/dense", "colmap/dense")
"""Where a workspace is looked for below a recording, in this order."""

ROTATION = 1.0
"""Relative rotations of two cameras may differ by this between recording and workspace, degrees: bundle adjustment
moves them by a few tenths."""

TRANSLATION = 0.03
"""And their relative translation, after scaling, by this share of it."""

FRAME_IN_BRACES = re.compile(r"\{frame(?::0?[0-9]{1,2}d?)?\}")
"""Where stereo.folder has the number of a frame."""

HEADER = re.compile(rb"(\d{1,9})&(\d{1,9})&(\d{1,2})&")
HEADER_LENGTH = 64  # bytes, more than any header has

KINDS = ("geometric", "photometric")
"""COLMAP's maps of a view: those of the pass that asks the other views' depths are taken where there are any."""

logger = logging.getLogger(__name__)


class WorkspaceDepth:
    """Depth maps of one workspace for all frames, or of one per frame.

    Args:
        root: folder that `place` is relative to.
        place: path of the workspace; `{frame}` in it stands for the frame number.
        cameras: the cameras whose poses are compared.
        frames: of the recording. Where there are several, an image serves only the frame that its name tells: a
            workspace of one instant, as many recordings have for their initial points, must not become the depth of all
            instants.
    """

    name: ClassVar[str] = "workspace"

    def __init__(self, root: Path, place: str, cameras: Sequence[Camera], frames: Sequence[int]) -> None:
        self.root, self.place, self.cameras = root, place, list(cameras)
        self.one_instant = "{frame" in place or len(frames) == 1
        self.about = f"depth maps of the COLMAP workspace {place}"
        self._read: Path | None = None
        self._compared: Path | None = None
        self._model: ColmapModel | None = None
        self._images: dict[tuple[str, int | None], ColmapImage] = {}
        self._strangers: list[str] = []
        self._scale = 1.0

    @classmethod
    def find(
        cls, root: Path, settings: StereoSettings, cameras: Sequence[Camera], frames: Sequence[int]
    ) -> WorkspaceDepth | None:
        """The first place below `root` that has depth maps, or None.

        Where the settings do not name it, it must serve the first frame and the last.
        """
        for place in [settings.folder] if settings.folder else PLACES:
            source = cls(root, place, cameras, frames)
            chosen = settings.matcher == cls.name and any(source.has_maps(frame) for frame in frames)
            if chosen or all(source.serves(frame) for frame in (frames[0], frames[-1])):
                return source
        return None

    def has_maps(self, frame: int) -> bool:
        """Whether the workspace of that frame holds any depth map."""
        maps = self._folder(frame) / "stereo" / "depth_maps"
        return maps.is_dir() and next(maps.rglob("*.bin"), None) is not None

    def serves(self, frame: int) -> bool:
        """Whether there are maps, and the model knows one of our cameras at that frame."""
        if not self.has_maps(frame):
            return False
        self._read_model(self._folder(frame))
        return any(self._image(camera.name, frame) for camera in self.cameras)

    def depth(self, camera: Camera, frame: int) -> np.ndarray | None:
        """The map of one camera at one frame, at its size and in its world's units; None where there is none.

        Raises:
            D2Error: poses that are not those of the recording, a lens that is no pinhole, a damaged map.
        """
        folder = self._folder(frame)
        if not self.has_maps(frame):
            return None
        model = self._read_model(folder)
        if folder != self._compared:
            self._compare_poses(folder, frame)
        image = self._image(camera.name, frame)
        path = None if image is None else self._map(folder, image.name)
        if image is None or path is None:
            return None
        depth = read_dense_array(path)
        return seen_by(camera, depth, _intrinsics(model, image, depth.shape)) * np.float32(self._scale)

    def _folder(self, frame: int) -> Path:
        # Only these two forms: a width in braces could be any, and what stands behind a dot is looked up.
        rest = FRAME_IN_BRACES.sub("", self.place)
        if "{" in rest or "}" in rest:
            raise D2Error(
                f"stereo.folder {self.place} has braces around other than frame: write {{frame}}, or {{frame:05d}} for "
                "numbers with zeros in front"
            )
        return self.root / self.place.format(frame=frame)

    def _read_model(self, folder: Path) -> ColmapModel:
        """The cameras and images of a workspace; the one that was read last is kept."""
        if self._model is None or folder != self._read:
            sparse = folder / "sparse"
            self._model = read_model(sparse / "0" if (sparse / "0").is_dir() else sparse)
            self._images, self._strangers = _by_camera_and_frame(self._model, [camera.name for camera in self.cameras])
            self._read = folder
        return self._model

    def _compare_poses(self, folder: Path, frame: int) -> None:
        """The scale of a workspace's world, once its cameras are known to be ours."""
        images = {camera.name: self._image(camera.name, frame) for camera in self.cameras}
        poses = {name: image.T_camera_world for name, image in images.items() if image is not None}
        if not poses:
            raise D2Error(
                f"the workspace {folder} has no image of {', '.join(images)} at frame {frame}: name images "
                "CAMERA/FRAME.png, or CAMERA.png where the folder is of one frame, or set matcher = patchmatch"
            )
        self._scale = scale_of_world([camera for camera in self.cameras if camera.name in poses], poses, folder)
        self._compared = folder
        if self._strangers:
            logger.warning(
                "the workspace %s saw %s as well: where a camera is held out, compute it without that camera",
                folder,
                ", ".join(self._strangers[:3]) + (", ..." if len(self._strangers) > 3 else ""),
            )

    def _image(self, camera: str, frame: int) -> ColmapImage | None:
        """The image of one camera and frame, or of one camera where the workspace is of one instant."""
        image = self._images.get((camera, frame))
        return self._images.get((camera, None)) if image is None and self.one_instant else image

    def _map(self, folder: Path, name: str) -> Path | None:
        paths = (folder / "stereo" / "depth_maps" / f"{name}.{kind}.bin" for kind in KINDS)
        return next((path for path in paths if path.is_file()), None)


def read_dense_array(path: Path) -> np.ndarray:
    """A depth map as float32 [H, W], 0 where there is none: the text `W&H&1&`, then little-endian float32.

    The format is that of COLMAP's `mvs/mat.h`.

    Raises:
        D2Error: there is no such file, it has no header, or more or fewer numbers than the header says.
    """
    data = read_bytes(path, "let COLMAP compute the map again")
    header = HEADER.match(data[:HEADER_LENGTH])
    if header is None:
        raise D2Error(f"{path} does not begin with width&height&channels& as COLMAP's maps do: compute it again")
    width, height, channels = (int(number) for number in header.groups())
    if width * height == 0 or channels != 1:
        raise D2Error(f"{path} is {width}x{height}x{channels}, expected pixels of one number each: compute it again")
    held, expected = len(data) - header.end(), 4 * width * height
    if held != expected:
        raise D2Error(f"{path} holds {held} bytes of numbers but {width}x{height} need {expected}: compute it again")
    depth = np.frombuffer(data, "<f4", offset=header.end()).reshape(height, width)
    return np.ascontiguousarray(depth, dtype=np.float32)


def _intrinsics(model: ColmapModel, image: ColmapImage, shape: tuple[int, ...]) -> np.ndarray:
    """K [3, 3] of a map, which COLMAP may have computed at less than the size of its image."""
    recorded = model.cameras[image.camera]
    lens = recorded.lens(str(model.folder))
    if lens.bends:
        raise D2Error(f"{model.folder} has images with lens distortion: give the output of `colmap image_undistorter`")
    return np.diag([shape[1] / recorded.width, shape[0] / recorded.height, 1.0]) @ lens.K


def _by_camera_and_frame(
    model: ColmapModel, cameras: Sequence[str]
) -> tuple[dict[tuple[str, int | None], ColmapImage], list[str]]:
    """Images by camera and frame (None where the name tells none), and the names of those of no camera of ours.

    CAMERA/FRAME.png, CAMERA_FRAME.png (with letters before the number, if any) and CAMERA.png are understood.
    """
    ours: dict[tuple[str, int | None], ColmapImage] = {}
    strangers = []
    patterns = {camera: re.compile(rf"{re.escape(camera)}(?:[/_]\D*(\d+))?") for camera in cameras}
    for image in model.images.values():
        stem = PurePosixPath(image.name).with_suffix("").as_posix()
        matches = {camera: match for camera, pattern in patterns.items() if (match := pattern.fullmatch(stem))}
        if not matches:
            strangers.append(image.name)
        for camera, match in matches.items():
            ours[camera, None if match[1] is None else int(match[1])] = image
    return ours, sorted(strangers)


def seen_by(camera: Camera, depth: np.ndarray, K: np.ndarray) -> np.ndarray:
    """The map [h, w] of a pinhole K as another pinhole in the same place and pose sees it, float32 [H, W].

    Planar depth does not change between them; each ray takes the pixel it passes through, 0 outside of the map.
    """
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    lookup = K @ np.linalg.inv(camera.K)
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1) @ lookup.T
    # A ray may leave through the border by rounding alone, where both cameras are one and the same.
    column, row = (np.floor(pixels[..., axis] / pixels[..., 2] + 1e-6).astype(np.int64) for axis in (0, 1))
    inside = (column >= 0) & (row >= 0) & (column < depth.shape[1]) & (row < depth.shape[0])
    values = depth[np.where(inside, row, 0), np.where(inside, column, 0)]
    return np.where(inside & np.isfinite(values) & (values > 0), values, 0).astype(np.float32)


def scale_of_world(cameras: Sequence[Camera], poses: dict[str, np.ndarray], folder: Path) -> float:
    """Our world units per unit of the workspace, from the translations between cameras.

    Args:
        poses: T_camera_world [4, 4] in the workspace's world, by name.

    Raises:
        D2Error: the poses differ by more than a similarity, or those of one point by anything at all.
    """
    if all(same_spot(cameras[0], camera) for camera in cameras):
        if all(np.allclose(camera.T_camera_world, poses[camera.name], atol=1e-4) for camera in cameras):
            return 1.0
        raise _other_poses(folder, "they stand at one point in another world, whose scale cannot be known")
    ours, theirs = [], []
    for first, second in itertools.combinations(cameras, 2):
        here = relative_pose(first, second)
        there = poses[second.name] @ np.linalg.inv(poses[first.name])
        turned = np.arccos(np.clip((np.trace(here[:3, :3].T @ there[:3, :3]) - 1) / 2, -1, 1))
        if np.rad2deg(turned) > ROTATION:
            raise _other_poses(folder, f"{first.name} and {second.name} are {np.rad2deg(turned):.1f} degrees off")
        ours.append(here[:3, 3])
        theirs.append(there[:3, 3])
    here, there = np.concatenate(ours), np.concatenate(theirs)
    length = float(there @ there)
    scale = float(here @ there) / length if length else 0.0
    if not scale > 0 or np.linalg.norm(here - scale * there) > TRANSLATION * np.linalg.norm(here):
        raise _other_poses(folder, "the cameras stand in another arrangement")
    return scale


def _other_poses(folder: Path, difference: str) -> D2Error:
    return D2Error(
        f"the cameras of the workspace {folder} are not those of the recording ({difference}): compute it from the "
        "recording's poses, or set matcher = patchmatch"
    )
