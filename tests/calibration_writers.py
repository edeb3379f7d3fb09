"""Calibration files as other tools lay them out, written from known cameras without any of the plugin's own code.

Everything goes by way of OpenCV's conventions: pixels whose centres lie at whole numbers, rotation vectors of
`cv2.Rodrigues`, projections of `cv2.projectPoints`. Numbers are written with all their digits.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation


class Known(NamedTuple):
    """A camera that is known: K for OpenCV's pixels, OpenCV's or OpenCV fisheye's coefficients, world to camera."""

    name: str
    size: tuple[int, int]
    K: np.ndarray
    distortion: tuple[float, ...]
    R: np.ndarray
    t: np.ndarray
    fisheye: bool = False

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels [n, 2] of world points, centres at whole numbers."""
        vector, coefficients = cv2.Rodrigues(self.R)[0], np.array(self.distortion)
        if self.fisheye:
            return cv2.fisheye.projectPoints(points[:, None], vector, self.t, self.K, coefficients)[0][:, 0]
        return cv2.projectPoints(points, vector, self.t, self.K, coefficients)[0][:, 0]


Writer = Callable[[Path, Sequence[Known]], Path]


def rig(
    coefficients: int = 5, fisheye: bool = False, names: Sequence[str] = ("cam_0", "cam_1", "cam_2")
) -> list[Known]:
    """Three cameras around the origin that differ in everything."""
    barrel = (-0.21, 0.07, 1.3e-3, -8e-4, -0.011, 0.013, 0.004, 0.002)
    equidistant = (-0.03, 0.008, -0.002, 0.0004)
    found = []
    for number, name in enumerate(names):
        angle = 0.4 * (number - 1)
        R = Rotation.from_euler("yxz", [angle, 0.1 + 0.05 * number, 0.02 * number]).as_matrix()
        t = np.array([0.1 * number, -0.05, 3.0 + 0.1 * number])
        width, height = (1280, 720) if number else (1080, 1920)
        K = np.array([[900.0 + number, 0, width / 2 + 7.3], [0, 903.0 - number, height / 2 - 4.1], [0, 0, 1]])
        values = equidistant if fisheye else barrel[:coefficients]
        found.append(Known(name, (width, height), K, values, R, t, fisheye))
    return found


def pose_of(camera: Known) -> np.ndarray:
    """World to camera [4, 4]."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = camera.R, camera.t
    return pose


def corner_pinhole(camera: Known) -> list[float]:
    """fx, fy, cx, cy where the centre of the first pixel lies at a half."""
    return [camera.K[0, 0], camera.K[1, 1], camera.K[0, 2] + 0.5, camera.K[1, 2] + 0.5]


def in_first_camera(cameras: Sequence[Known]) -> list[Known]:
    """The same rig in a world that is the first camera's."""
    poses = [pose_of(camera) @ np.linalg.inv(pose_of(cameras[0])) for camera in cameras]
    return [camera._replace(R=pose[:3, :3], t=pose[:3, 3]) for camera, pose in zip(cameras, poses, strict=True)]


def opencv_storage(path: Path, entries: Mapping[str, Any]) -> Path:
    """A file that OpenCV writes, YAML or XML by its suffix; a list is a sequence."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        if isinstance(value, list):
            storage.startWriteStruct(name, cv2.FileNode_SEQ)
            for item in value:
                storage.write("", item)
            storage.endWriteStruct()
        else:
            storage.write(name, value)
    storage.release()
    return path


def toml(file: str, prefix: str = "", metadata: str = "", matrix: bool = False) -> Writer:
    """Writes Pose2Sim's, Anipose's and Caliscope's tables."""

    def write(path: Path, cameras: Sequence[Known]) -> Path:
        text = ""
        for number, camera in enumerate(cameras):
            rotation = camera.R if matrix else cv2.Rodrigues(camera.R)[0].ravel()
            text += f"[{f'{prefix}{number}' if prefix else camera.name}]\n"
            text += f"cam_id = {number}\n" if prefix else f'name = "{camera.name}"\n'
            text += f"size = {list(camera.size) if prefix else [float(side) for side in camera.size]}\n"
            text += f"matrix = {camera.K.tolist()}\ndistortions = {list(camera.distortion)}\n"
            text += f"rotation = {np.asarray(rotation).tolist()}\ntranslation = {camera.t.tolist()}\n"
            text += f"fisheye = {str(camera.fisheye).lower()}\n\n"
        (path / file).write_text(text + metadata)
        return path / file

    return write


pose2sim = toml("Calib_board.toml", metadata="[metadata]\nadjusted = false\nerror = 0.0\n")
anipose = toml("calibration.toml", metadata="[metadata]\nerror = 0.31\n")
caliscope = toml("camera_array.toml", prefix="cameras.")
old_caliscope = toml("config.toml", prefix="cameras.", matrix=True)


def easymocap(path: Path, cameras: Sequence[Known]) -> Path:
    names = [camera.name for camera in cameras]
    lenses: dict[str, Any] = {"names": names}
    poses: dict[str, Any] = {"names": names}
    for camera in cameras:
        lenses |= {f"K_{camera.name}": camera.K, f"dist_{camera.name}": np.array([camera.distortion])}
        lenses |= {f"W_{camera.name}": camera.size[0], f"H_{camera.name}": camera.size[1]}
        poses |= {f"R_{camera.name}": cv2.Rodrigues(camera.R)[0], f"Rot_{camera.name}": camera.R}
        poses[f"T_{camera.name}"] = camera.t[:, None]
    opencv_storage(path / "intri.yml", lenses)
    opencv_storage(path / "extri.yml", poses)
    return path


def kalibr(path: Path, cameras: Sequence[Known]) -> Path:
    content: dict[str, Any] = {}
    for number, camera in enumerate(cameras):
        entry: dict[str, Any] = {
            "cam_overlaps": [other for other in range(len(cameras)) if other != number],
            "camera_model": "pinhole",
            "distortion_coeffs": list(camera.distortion),
            "distortion_model": "equidistant" if camera.fisheye else "radtan",
            "intrinsics": [camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]],
            "resolution": list(camera.size),
            "rostopic": f"/cam{number}/image_raw",
        }
        if number:
            entry["T_cn_cnm1"] = (pose_of(camera) @ np.linalg.inv(pose_of(cameras[number - 1]))).tolist()
        content[f"cam{number}"] = json.loads(json.dumps(entry))
    (path / "camchain.yaml").write_text(yaml.safe_dump(content))
    return path / "camchain.yaml"


def multical(path: Path, cameras: Sequence[Known]) -> Path:
    intrinsics = {
        camera.name: {
            "model": "standard",
            "image_size": camera.size,
            "K": camera.K.tolist(),
            "dist": [camera.distortion],
        }
        for camera in cameras
    }
    poses = {camera.name: {"R": camera.R.tolist(), "T": camera.t.tolist()} for camera in cameras}
    content = {"cameras": intrinsics, "camera_poses": poses, "image_sets": {"rgb": []}}
    (path / "calibration.json").write_text(json.dumps(content, indent=4))
    return path / "calibration.json"


def panoptic(path: Path, cameras: Sequence[Known]) -> Path:
    entries = [
        {"name": camera.name, "type": "hd", "resolution": camera.size, "panel": 0, "node": number,
         "K": camera.K.tolist(), "distCoef": camera.distortion, "R": camera.R.tolist(),
         "t": (100 * camera.t)[:, None].tolist()}
        for number, camera in enumerate(cameras)
    ]  # fmt: skip
    content = {"calibDataSource": "160401_calib_norm", "cameras": entries}
    (path / "calibration_dance.json").write_text(json.dumps(content))
    return path / "calibration_dance.json"


def qualisys(path: Path, cameras: Sequence[Known]) -> Path:
    """QTM's XML, in 64ths of a pixel and millimetres, from a field of view that begins at 16, 8."""
    entries = []
    for camera in cameras:
        k1, k2, p1, p2, k3 = camera.distortion
        (width, height), gl, centre = camera.size, np.diag([1.0, -1, -1]) @ camera.R, -1000 * camera.R.T @ camera.t
        fx, fy, cx, cy = (
            64 * (value + more) for value, more in zip(camera.K[[0, 1, 0, 1], [0, 1, 2, 2]], (0, 0, 16, 8))
        )
        r = " ".join(f'r{i + 1}{j + 1}="{gl[i, j]!r}"' for i in range(3) for j in range(3))
        x, y, z = map(float, centre)
        entries.append(
            f'<camera active="1" serial="{camera.name}" model="Miqus Video" viewrotation="0">'
            f'<fov_video left="16" top="8" right="{width + 15}" bottom="{height + 7}"/>'
            f'<transform x="{x}" y="{y}" z="{z}" {r.replace("np.float64(", "").replace(")", "")}/>'
            f'<intrinsic focalLengthU="{fx}" focalLengthV="{fy}" centerPointU="{cx}" centerPointV="{cy}" skew="0"'
            f' radialDistortion1="{k1}" radialDistortion2="{k2}" radialDistortion3="{k3}"'
            f' tangentalDistortion1="{p1}" tangentalDistortion2="{p2}"/></camera>'
        )
    inactive = '<camera active="0" serial="other"/>'
    text = f'<?xml version="1.0" encoding="ASCII"?>\n<calibration>\n<cameras>{"".join(entries)}{inactive}</cameras>'
    (path / "Calib.qca.txt").write_text(f"{text}</calibration>")
    return path / "Calib.qca.txt"


def opencv_many(file: str) -> Writer:
    """Writes what the multi-camera calibration of OpenCV's ccalib writes."""

    def write(path: Path, cameras: Sequence[Known]) -> Path:
        entries: dict[str, Any] = {"nCameras": len(cameras)}
        for number, camera in enumerate(in_first_camera(cameras)):
            entries |= {
                f"camera_matrix_{number}": camera.K,
                f"camera_distortion_{number}": np.array([camera.distortion]),
                f"camera_pose_{number}": pose_of(camera),
            }
        return opencv_storage(path / file, entries | {"meanReprojectError": 0.3})

    return write


def opencv_stereo(path: Path, cameras: Sequence[Known]) -> Path:
    """What OpenCV's `stereo_calib` writes of the first two cameras."""
    lenses: dict[str, Any] = {}
    for number, camera in enumerate(cameras[:2], start=1):
        lenses |= {f"M{number}": camera.K, f"D{number}": np.array([camera.distortion])}
    other = in_first_camera(cameras)[1]
    opencv_storage(path / "extrinsics.xml", {"R": other.R, "T": other.t[:, None], "Q": np.eye(4)})
    return opencv_storage(path / "intrinsics.xml", lenses)


def transforms(path: Path, cameras: Sequence[Known]) -> Path:
    flip = np.diag([1.0, -1, -1, 1])
    frames = []
    for camera in cameras:
        entry: dict[str, Any] = {"file_path": f"images/{camera.name}/000000.png", "camera_label": camera.name}
        entry |= {"transform_matrix": (np.linalg.inv(pose_of(camera)) @ flip).tolist()}
        entry |= dict(zip(("w", "h"), camera.size, strict=True))
        entry |= dict(zip(("fl_x", "fl_y", "cx", "cy"), corner_pinhole(camera), strict=True))
        entry |= dict(zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion, strict=True))
        frames.append(entry)
    (path / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", "frames": frames}))
    return path / "transforms.json"


def cameras_json(path: Path, cameras: Sequence[Known]) -> Path:
    entries = []
    for camera in cameras:
        entry: dict[str, Any] = {"name": camera.name, "R": camera.R.tolist(), "t": camera.t.tolist()}
        entry |= {"model": "fisheye" if camera.fisheye else "opencv", "distortion": camera.distortion}
        entry |= dict(zip(("width", "height"), camera.size, strict=True))
        entries.append(entry | dict(zip(("fx", "fy", "cx", "cy"), corner_pinhole(camera), strict=True)))
    (path / "cameras.json").write_text(json.dumps({"cameras": entries}))
    return path / "cameras.json"


def _reconstruction(cameras: Sequence[Known]) -> Any:
    """A model of pycolmap's own."""
    import pycolmap

    found = pycolmap.Reconstruction()
    for number, camera in enumerate(cameras, start=1):
        k = (*camera.distortion, 0, 0, 0)[:8]
        model, more = ("OPENCV_FISHEYE", k[:4]) if camera.fisheye else ("FULL_OPENCV", k)
        width, height = camera.size
        lens = pycolmap.Camera(model=model, width=width, height=height, camera_id=number)
        lens.params = [*corner_pinhole(camera), *more]
        found.add_camera_with_trivial_rig(lens)
        image = pycolmap.Image(name=f"{camera.name}/000000.png", camera_id=number, image_id=number)
        found.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(camera.R), camera.t))
    return found


def colmap_binary(path: Path, cameras: Sequence[Known]) -> Path:
    folder = path / "sparse" / "0"
    folder.mkdir(parents=True)
    _reconstruction(cameras).write_binary(str(folder))
    return path


def colmap_text_of_a_rig(path: Path, cameras: Sequence[Known]) -> Path:
    """All cameras are one rig that stands in one frame."""
    import pycolmap

    single = _reconstruction(cameras)
    found, rig, frame = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1), pycolmap.Frame(frame_id=1, rig_id=1)
    frame.rig_from_world = single.images[1].cam_from_world()
    for number, lens in sorted(single.cameras.items()):
        found.add_camera(lens)
        if number == 1:
            rig.add_ref_sensor(lens.sensor_id)
        else:
            rig.add_sensor(lens.sensor_id, single.images[number].cam_from_world() * frame.rig_from_world.inverse())
        frame.add_data_id(pycolmap.data_t(lens.sensor_id, number))
    found.add_rig(rig)
    found.add_frame(frame)
    for number, image in sorted(single.images.items()):
        found.add_image(pycolmap.Image(name=image.name, camera_id=number, image_id=number, frame_id=1))
    found.register_frame(1)
    found.write_text(str(path))
    return path


def rig_config(path: Path, cameras: Sequence[Known]) -> Path:
    """COLMAP's rig_config.json: the first camera's axes are the rig's."""
    entries: list[dict[str, Any]] = []
    for number, camera in enumerate(in_first_camera(cameras)):
        entry: dict[str, Any] = {"image_prefix": f"rig1/{camera.name}/", "camera_model_name": "FULL_OPENCV"}
        entry["camera_params"] = [*corner_pinhole(camera), *camera.distortion, *[0] * (8 - len(camera.distortion))]
        x, y, z, w = Rotation.from_matrix(camera.R).as_quat()
        placed = {"cam_from_rig_rotation": [w, x, y, z], "cam_from_rig_translation": camera.t.tolist()}
        entries.append(entry | (placed if number else {"ref_sensor": True}))
    (path / "rig_config.json").write_text(json.dumps([{"cameras": entries}]))
    return path / "rig_config.json"


class Case(NamedTuple):
    """One format: how it is written, what the table calls it, which lenses it holds."""

    write: Writer
    format: str
    coefficients: int = 5
    fisheye: bool = False
    relative: bool = False
    """The world is the first camera's."""
    names: tuple[str, ...] = ("cam_0", "cam_1", "cam_2")
    sizes: bool = True
    """The file says how large the images are."""


CASES = {
    "pose2sim": Case(pose2sim, "pose2sim", coefficients=4, names=("int_cam1_img", "int_cam2_img", "int_cam3_img")),
    "anipose": Case(anipose, "anipose"),
    "anipose, fisheye": Case(anipose, "anipose", fisheye=True),
    "caliscope": Case(caliscope, "caliscope"),
    "caliscope, fisheye": Case(caliscope, "caliscope", fisheye=True),
    "caliscope, older": Case(old_caliscope, "caliscope"),
    "easymocap": Case(easymocap, "easymocap", names=("00", "11", "cam-x")),
    "kalibr": Case(kalibr, "kalibr", coefficients=4, relative=True, names=("cam0", "cam1", "cam2")),
    "kalibr, equidistant": Case(kalibr, "kalibr", fisheye=True, relative=True, names=("cam0", "cam1", "cam2")),
    "multical": Case(multical, "multical"),
    "multical, rational": Case(multical, "multical", coefficients=8),
    "panoptic": Case(panoptic, "panoptic", names=("00_00", "00_01", "00_02")),
    "qualisys": Case(qualisys, "qualisys"),
    "opencv, xml": Case(opencv_many("multi.xml"), "opencv", relative=True, names=("cam0", "cam1", "cam2"), sizes=False),
    "opencv, yaml": Case(
        opencv_many("multi.yml"), "opencv", coefficients=8, relative=True, names=("cam0", "cam1", "cam2"), sizes=False
    ),
    "opencv, stereo": Case(opencv_stereo, "opencv", relative=True, names=("cam1", "cam2"), sizes=False),
    "transforms": Case(transforms, "transforms"),
    "colmap, binary": Case(colmap_binary, "colmap"),
    "colmap, fisheye": Case(colmap_binary, "colmap", fisheye=True),
    "colmap, text of a rig": Case(colmap_text_of_a_rig, "colmap", coefficients=8),
    "colmap's rig_config": Case(rig_config, "colmap_rig", coefficients=8, relative=True, sizes=False),
    "cameras.json": Case(cameras_json, "folder"),
    "cameras.json, fisheye": Case(cameras_json, "folder", fisheye=True),
}
