"""Files as tools lay them out, where that differs from what `calibration_writers` writes; the numbers are made up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2", reason="opencv is in the `calibration` extra")
pytest.importorskip("yaml", reason="pyyaml is in the `calibration` extra")

from d2_plugin.recordings.cameras.calibration import open_calibration
from d2_plugin.recordings.cameras.camera import CalibratedCamera

CALISCOPE = """[cameras.0]
cam_id = 0
size = [1280, 720]
rotation_count = 0
error = 0.224
matrix = [[910.1, 0.0, 640.2], [0.0, 909.4, 355.9], [0.0, 0.0, 1.0]]
distortions = [0.081, -0.153, -0.0011, 0.0004, 0.052]
translation = [0.11, -0.02, 1.9]
rotation = [0.02, 0.81, -0.03]
exposure = -5
grid_count = 25
fisheye = false

[cameras.3]
cam_id = 3
size = [720, 1280]
rotation_count = -1
error = 0.31
matrix = [[902.0, 0.0, 361.0], [0.0, 902.5, 640.0], [0.0, 0.0, 1.0]]
distortions = [0.01, -0.02, 0.003, 0.0004]
translation = [0.0, 0.0, 0.0]
rotation = [0.0, 0.0, 0.0]
grid_count = 21
fisheye = true
"""

ANIPOSE = """[cam_0]
name = "A"
size = [ 640, 480,]
matrix = [ [ 610.5, 0.0, 319.5,], [ 0.0, 610.5, 239.5,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.29, 0.0, 0.0, 0.0, 0.0,]
rotation = [ 0.001, 0.002, -0.001,]
translation = [ 1.0, 2.0, 3.0,]

[cam_1]
name = "B"
size = [ 640, 480,]
matrix = [ [ 612.0, 0.0, 319.5,], [ 0.0, 612.0, 239.5,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.28, 0.0, 0.0, 0.0, 0.0,]
rotation = [ 0.3, 1.2, -0.4,]
translation = [ -150.5, 20.25, 210.0,]

[metadata]
adjusted = false
error = 0.812
"""

INTRI = """%YAML:1.0
---
names:
  - "01"
  - "02"
  - "07"
K_01: !!opencv-matrix
  rows: 3
  cols: 3
  dt: d
  data: [1605.067, 0.000000, 1002.329, 0.000000, 1611.180, 533.332, 0.000000, 0.000000, 1.000000]
dist_01: !!opencv-matrix
  rows: 1
  cols: 5
  dt: d
  data: [-0.003509, -0.546545, -0.002931, 0.006635, 0.000000]
K_02: !!opencv-matrix
  rows: 3
  cols: 3
  dt: d
  data: [1600., 0., 960.,
     0., 1600., 540., 0., 0., 1.]
D_02: !!opencv-matrix
  rows: 5
  cols: 1
  dt: d
  data: [0.1, 0., 0., 0., 0.02]
K_07: !!opencv-matrix
  rows: 3
  cols: 3
  dt: d
  data: [1600., 0., 960., 0., 1600., 540., 0., 0., 1.]
"""

EXTRI = """%YAML:1.0
---
names:
  - "01"
  - "02"
R_01: !!opencv-matrix
  rows: 3
  cols: 1
  dt: d
  data: [1.631797, -1.236095, 0.801056]
Rot_01: !!opencv-matrix
  rows: 3
  cols: 3
  dt: d
  data: [0.287431, -0.957452, -0.025882, -0.492498, -0.124632, -0.861344, 0.821471, 0.260323, -0.507367]
T_01: !!opencv-matrix
  rows: 3
  cols: 1
  dt: d
  data: [0.327633, 1.096058, 3.260243]
R_02: !!opencv-matrix
  rows: 3
  cols: 1
  dt: d
  data: [0., 0., 0.]
T_02: !!opencv-matrix
  rows: 3
  cols: 1
  dt: d
  data: [0., 0., 4.]
"""

MULTICAL = """{
  "cameras": {
    "cam1": {
      "model": "standard",
      "image_size": [1280, 960],
      "K": [[1190.1, 0.0, 640.9], [0.0, 1189.9, 480.6], [0.0, 0.0, 1.0]],
      "dist": [[-0.11, 0.09, 0.0, 0.001, 0.02]]
    },
    "cam2": {
      "model": "standard",
      "image_size": [1280, 960],
      "K": [[1200.0, 0.0, 640.0], [0.0, 1200.0, 480.0], [0.0, 0.0, 1.0]],
      "dist": [[0.0, 0.0, 0.0, 0.0, 0.0]]
    }
  },
  "camera_poses": {
    "cam1": {"R": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], "T": [0.0, 0.0, 0.0]},
    "cam2_to_cam1": {"R": [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], "T": [0.1, 0.2, 0.3]}
  },
  "image_sets": {"rgb": [{"cam1": "cam1/0.png", "cam2": "cam2/0.png"}]}
}
"""


def read(path: Path, text: str, **sizes: tuple[int, int]) -> dict[str, CalibratedCamera]:
    path.write_text(text)
    return {camera.name: camera for camera in open_calibration(path, sizes or None).cameras}


def test_caliscope(tmp_path: Path) -> None:
    cameras = read(tmp_path / "camera_array.toml", CALISCOPE)
    assert list(cameras) == ["cam_0", "cam_3"]
    assert cameras["cam_0"].lens.distortion[4] == 0.052
    assert (cameras["cam_3"].lens.model, cameras["cam_3"].width) == ("fisheye", 720)
    np.testing.assert_array_equal(cameras["cam_3"].T_camera_world[:3, :3], np.eye(3))


def test_anipose_whose_board_was_measured_in_millimetres(tmp_path: Path) -> None:
    (tmp_path / "calibration.toml").write_text(ANIPOSE)
    found = open_calibration(tmp_path / "calibration.toml")
    assert [camera.name for camera in found.cameras] == ["A", "B"]
    assert "centimetres (scale .01) or, of a small rig, millimetres (scale .001)" in found.notes[0]


def test_easymocap(tmp_path: Path) -> None:
    (tmp_path / "extri.yml").write_text(EXTRI)
    sizes = {"01": (1920, 1080), "02": (1920, 1080)}
    (tmp_path / "intri.yml").write_text(INTRI)
    one, other = open_calibration(tmp_path, sizes).cameras
    np.testing.assert_allclose(one.T_camera_world[:3, :3][0], [0.287431, -0.957452, -0.025882], atol=2e-6)
    np.testing.assert_allclose(one.T_camera_world[:3, :3] @ one.T_camera_world[:3, :3].T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(one.lens.K[:2, 2], [1002.829, 533.832])
    assert one.lens.distortion == (-0.003509, -0.546545, -0.002931, 0.006635, 0.0)
    assert other.lens.distortion == (0.1, 0, 0, 0, 0.02)
    np.testing.assert_allclose(other.centre, [0, 0, -4])


def test_multical_with_a_master_camera(tmp_path: Path) -> None:
    cameras = read(tmp_path / "calibration.json", MULTICAL)
    np.testing.assert_allclose(cameras["cam2"].T_camera_world[:3, 3], [0.1, 0.2, 0.3])
    assert cameras["cam1"].lens.distortion == (-0.11, 0.09, 0, 0.001, 0.02)
