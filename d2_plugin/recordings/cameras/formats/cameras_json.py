"""This project's own cameras.json, as the folder layout has it.

{"cameras": [{"name", "width", "height", "fx", "fy", "cx", "cy", "R", "t", "model"?, "distortion"?}], "fps", "bounds"}
with OpenCV axes, x_cam = R X + t and the centre of pixel i at i + 0.5. `model` is one of `MODELS`, pinhole where
nothing is said; with another one the images are undistorted when they are read.
"""

from __future__ import annotations

from typing import Any, Optional, Union

from d2_plugin.errors import D2Error
from d2_plugin.reading import field
from d2_plugin.recordings.cameras.camera import CalibratedCamera, pinhole, rigid
from d2_plugin.recordings.cameras.formats.document import (
    CORRECT,
    NUMBER,
    Document,
    Table,
    coefficients,
    has,
    numbers,
    object_of,
)
from d2_plugin.recordings.cameras.lens import checked_lens
from d2_plugin.recordings.recording import Camera


def read_cameras_json(document: Document) -> list[CalibratedCamera] | None:
    """An object with a list `cameras` whose entries have `fx`, `R` and `t`."""
    if not has(document.cameras(), "fx", "R", "t"):
        return None
    return [read_camera(entry, document.place) for entry in document.cameras()]


def read_camera(entry: Any, path: str, bounds: Table | None = None) -> CalibratedCamera:
    """One camera of the list in the file `path`, with its depth range where `bounds` has one."""
    table = object_of(entry, f"a camera in {path}")
    name = str(field(table, "name", Union[str, int], f"a camera in {path}", CORRECT))  # noqa: UP007
    where = f"camera {name} in {path}"
    K = pinhole(*(field(table, key, NUMBER, where, CORRECT) for key in ("fx", "fy", "cx", "cy")))
    width, height = (field(table, key, int, where, CORRECT) for key in ("width", "height"))
    pose = rigid(numbers(table, "R", (3, 3), where), numbers(table, "t", (3,), where))
    if any(table.get(name) for name in ("k1", "k2", "k3", "p1", "p2")):
        raise D2Error(
            f'{where} has distortion as k1, k2 and others: write "model": "opencv", "distortion": [k1, k2, p1, p2, k3]'
        )
    model = field(table, "model", str, where, CORRECT, default="pinhole")
    lens = checked_lens(K, model, coefficients(table, "distortion", where), where)
    pair = Optional[tuple[NUMBER, NUMBER]]  # noqa: UP045  at run time, on Python 3.9 too
    near_far = field(bounds or {}, name, pair, f"bounds in {path}", CORRECT, default=None)
    return CalibratedCamera(name, width, height, lens, pose, near_far)


def camera_table(camera: Camera | CalibratedCamera) -> Table:
    """What `read_camera` understands of a camera, lens included; R and t are in the unit of the camera.

    Raises:
        D2Error: a camera with skew, which the layout cannot say.
    """
    K = camera.K if isinstance(camera, Camera) else camera.lens.K
    refuse_skew(camera.name, K)
    table: Table = {"name": camera.name, "width": camera.width, "height": camera.height}
    table |= {"fx": float(K[0, 0]), "fy": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
    table |= {"R": camera.T_camera_world[:3, :3].tolist(), "t": camera.T_camera_world[:3, 3].tolist()}
    if isinstance(camera, CalibratedCamera) and camera.lens.model != "pinhole":
        table |= {"model": camera.lens.model, "distortion": list(camera.lens.distortion)}
    return table


def refuse_skew(name: str, K: Any) -> None:
    """Raise `D2Error` for a camera whose pixel axes are not perpendicular: no layout can say so."""
    if K[0, 1] != 0:
        raise D2Error(f"camera {name} has skew {K[0, 1]:g}, which no layout holds: undistort its images first")
