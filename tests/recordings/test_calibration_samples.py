"""Files as the tools themselves lay them out, down to spaces, orders and unused keys; the numbers are made up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2", reason="opencv is in the `calibration` extra")
pytest.importorskip("yaml", reason="pyyaml is in the `calibration` extra")

from d2_plugin.recordings.cameras.calibration import CalibratedCamera, open_calibration

POSE2SIM = """[cam_01]
name = "cam_01"
size = [ 1088.0, 1920.0]
matrix = [ [ 1677.425415046875, 0.0, 537.2604655859375], [ 0.0, 1677.546712765625, 931.1350410703125], [ 0.0, 0.0, 1.0]]
distortions = [ -0.00071826, 0.00198412, 5.31e-05, -0.00012]
rotation = [ 1.3, -0.5, 0.5]
translation = [ -0.41, 0.88, 3.79]
fisheye = false

[cam_02]
name = "cam_02"
size = [ 1088.0, 1920.0]
matrix = [ [ 1681.0, 0.0, 540.0], [ 0.0, 1681.0, 960.0], [ 0.0, 0.0, 1.0]]
distortions = [ 0.0, 0.0, 0.0, 0.0]
rotation = [ 1.2, 0.5, -0.5]
translation = [ 0.4, 0.9, 3.8]
fisheye = false

[metadata]
adjusted = false
error = 0.0
"""

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

KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.294719325148729, 0.08601391290708914, -0.0003238494917967103, -0.00043467666542761]
  distortion_model: radtan
  intrinsics: [461.487246372674, 460.1113992557959, 362.680920605, 246.0490004344]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [0.9999972563, 0.0023174510, 0.0003433931, -0.1100738081]
  - [-0.0023120672, 0.9998980485, -0.0140898358, 0.0003991215]
  - [-0.0003760113, 0.0140890035, 0.9999006751, -0.0008537026]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [-0.01, 0.004, -0.002, 0.0003]
  distortion_model: equidistant
  intrinsics: [460.0, 459.0, 370.1, 250.9]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
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

PANOPTIC = """{
    "calibDataSource": "160422_calib_norm",
    "cameras": [
        {
            "name": "00_00",
            "type": "hd",
            "resolution": [1920,1080],
            "panel": 0,
            "node": 0,
            "K": [
                [1634.03,0,942.792],
                [0,1629.73,559.32],
                [0,0,1]
            ],
            "distCoef": [-0.222748,0.185341,-0.000271445,0.00103615,0.0665967],
            "R": [
                [0.0,0.0,1.0],
                [0.0,1.0,0.0],
                [-1.0,0.0,0.0]
            ],
            "t": [
                [-46.06],
                [140.10],
                [287.62]
            ]
        }
    ]
}
"""

NERFSTUDIO = """{
    "w": 960,
    "h": 540,
    "fl_x": 811.5,
    "fl_y": 810.25,
    "cx": 480.0,
    "cy": 270.0,
    "k1": 0.0307,
    "k2": -0.0412,
    "p1": 0.0003,
    "p2": -0.0001,
    "camera_model": "OPENCV",
    "frames": [
        {
            "file_path": "images/frame_00001.png",
            "transform_matrix": [
                [1.0, 0.0, 0.0, 0.5],
                [0.0, 0.0, -1.0, -2.0],
                [0.0, 1.0, 0.0, 0.25],
                [0.0, 0.0, 0.0, 1.0]
            ],
            "colmap_im_id": 1
        },
        {
            "file_path": "images/frame_00002.png",
            "transform_matrix": [
                [1.0, 0.0, 0.0, 1.5],
                [0.0, 0.0, -1.0, -2.0],
                [0.0, 1.0, 0.0, 0.25],
                [0.0, 0.0, 0.0, 1.0]
            ],
            "colmap_im_id": 2
        }
    ],
    "applied_transform": [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [-0.0, -1.0, -0.0, -0.0]],
    "ply_file_path": "sparse_pc.ply"
}
"""

COLMAP_CAMERAS = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 2
1 SIMPLE_RADIAL 1920 1080 1500.5 960 540 -0.012
2 OPENCV 1280 720 900 901 640 360 0.01 0.002 0.0003 0.0004
"""

COLMAP_IMAGES = """# Image list with two lines of data per image:
#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME
#   POINTS2D[] as (X, Y, POINT3D_ID)
# Number of images: 3, mean observations per image: 1
1 1 0 0 0 0 0 0 1 cam01/000000.jpg
960.5 540.5 1
2 1 0 0 0 0 0 0 1 cam01/000010.jpg

3 0.70710678118654757 0 0.70710678118654757 0 1 2 3 2 cam02/000000.jpg
640.5 360.5 1
"""


def read(path: Path, text: str, **sizes: tuple[int, int]) -> dict[str, CalibratedCamera]:
    path.write_text(text)
    return {camera.name: camera for camera in open_calibration(path, sizes or None).cameras}


def test_pose2sim(tmp_path: Path) -> None:
    camera = read(tmp_path / "Calib_qualisys.toml", POSE2SIM)["cam_01"]
    assert (camera.width, camera.height, camera.model) == (1088, 1920, "opencv")
    assert camera.matrix[0, 2] == 537.2604655859375 + 0.5
    assert camera.distortion == (-0.00071826, 0.00198412, 5.31e-05, -0.00012)
    assert np.rad2deg(np.arccos((np.trace(camera.rotation) - 1) / 2)) == pytest.approx(np.rad2deg(1.4798648586948742))


def test_caliscope(tmp_path: Path) -> None:
    cameras = read(tmp_path / "camera_array.toml", CALISCOPE)
    assert list(cameras) == ["cam_0", "cam_3"]
    assert cameras["cam_0"].distortion[4] == 0.052
    assert (cameras["cam_3"].model, cameras["cam_3"].width) == ("fisheye", 720)
    np.testing.assert_array_equal(cameras["cam_3"].rotation, np.eye(3))


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
    np.testing.assert_allclose(one.rotation[0], [0.287431, -0.957452, -0.025882], atol=2e-6)
    np.testing.assert_allclose(one.rotation @ one.rotation.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(one.matrix[:2, 2], [1002.829, 533.832])
    assert one.distortion == (-0.003509, -0.546545, -0.002931, 0.006635, 0.0)
    assert other.distortion == (0.1, 0, 0, 0, 0.02)
    np.testing.assert_allclose(other.centre, [0, 0, -4])


def test_kalibr(tmp_path: Path) -> None:
    cameras = read(tmp_path / "camchain-results.yaml", KALIBR)
    assert [camera.model for camera in cameras.values()] == ["opencv", "fisheye"]
    np.testing.assert_allclose(cameras["cam1"].translation, [-0.1100738081, 0.0003991215, -0.0008537026])
    assert cameras["cam0"].matrix[0, 0] == 461.487246372674


def test_multical_with_a_master_camera(tmp_path: Path) -> None:
    cameras = read(tmp_path / "calibration.json", MULTICAL)
    np.testing.assert_allclose(cameras["cam2"].translation, [0.1, 0.2, 0.3])
    assert cameras["cam1"].distortion == (-0.11, 0.09, 0, 0.001, 0.02)


def test_panoptic_is_in_metres(tmp_path: Path) -> None:
    camera = read(tmp_path / "calibration_160422_haggling1.json", PANOPTIC)["00_00"]
    np.testing.assert_allclose(camera.translation, [-0.4606, 1.401, 2.8762])
    assert (camera.width, camera.height) == (1920, 1080)


def test_nerfstudio(tmp_path: Path) -> None:
    cameras = read(tmp_path / "transforms.json", NERFSTUDIO)
    assert list(cameras) == ["frame_00001", "frame_00002"]
    np.testing.assert_allclose(cameras["frame_00002"].centre, [1.5, -2, 0.25])
    np.testing.assert_allclose(cameras["frame_00001"].rotation[2], [0, 1, 0])  # it looks along +y
    assert cameras["frame_00001"].distortion == (0.0307, -0.0412, 0.0003, -0.0001, 0)


def test_colmap_text(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text(COLMAP_CAMERAS)
    (tmp_path / "images.txt").write_text(COLMAP_IMAGES)
    for place in (tmp_path, tmp_path / "cameras.txt"):
        found = open_calibration(place)
        assert (found.format, [camera.name for camera in found.cameras]) == ("colmap", ["cam01", "cam02"])
        one, other = found.cameras
        assert (one.matrix[0, 0], one.matrix[0, 2], one.distortion[0]) == (1500.5, 960, -0.012)
        np.testing.assert_allclose(other.rotation, [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=1e-15)
        assert other.distortion == (0.01, 0.002, 0.0003, 0.0004, 0)
