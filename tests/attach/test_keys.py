"""Which camera and frame of the prior a trainer's camera object stands for."""

from types import SimpleNamespace

import pytest
from mimics import ex4dgs, fudan, hust4d
from mimics.inria import cameras_of
from refusals import refuses
from repositories import VARIANTS
from tiny import make_views

from d2_plugin.adapters.ex4dgs import Ex4DGSAdapter
from d2_plugin.adapters.fudan import FudanAdapter
from d2_plugin.adapters.hust4d import Hust4DAdapter
from d2_plugin.adapters.keys import KeysByPose, PriorKey, frame_of_time, key_from_image_name, one_image_each

READERS = [
    # adapter, what the reader leaves on a camera object, key; from the files of each repository at the pages' commits
    ("fudan", {"image_path": "/d/images/cam01_0003.png", "image_name": "cam01_0003", "uid": 9}, ("cam01", 3)),
    ("fudan", {"image_path": None, "image_name": "cam01_0003", "uid": 9}, ("cam01", 3)),
    ("fudan", {"image_path": "/data/scene/cam01/images/0003.png"}, ("cam01", 3)),
    ("fudan", {"image_path": "scene/cam07/frame_00012.jpg"}, ("cam07", 12)),
    ("fudan", {"image_path": "a_b_12.png"}, ("a_b", 12)),
    ("fudan", {"image_path": r"C:\scene\cam02\images\0004.png"}, ("cam02", 4)),
    ("deformable3d", {"image_name": "cam01_0003.png", "fid": 0.1}, ("cam01", 3)),
    ("deformable3d", {"image_name": "left1_000012", "fid": 0.1}, ("left1", 12)),
    ("spacetime", {"image_name": "cam04", "timestamp": 0.5}, ("cam04", 1)),
    ("spacetime", {"image_name": "camera_0001", "timestamp": 0.0}, ("camera_0001", 0)),
    ("ex4dgs", {"image_path": "/d/sear_steak/cam12/47.png", "image_name": "47.png", "timestamp": 40}, ("cam12", 47)),
    (
        "ex4dgs",
        {"image_path": "/d/Birthday/Birthday_undist_00151_10.png", "image_name": "Birthday_undist_00151_10.png"},
        ("10", 151),
    ),
    ("ex4dgs", {"image_path": "/d/Painter/Painter_undist_00000_00.png", "image_name": "-"}, ("00", 0)),
]


class TestNames:
    def test_a_name_without_a_camera_is_refused_with_the_way_out(self) -> None:
        refuses(r"image '0003.png' does not say its camera.*function `key`", key_from_image_name, "0003.png")

    def test_a_moving_camera_has_a_prior_for_each_image(self) -> None:
        assert one_image_each(SimpleNamespace(image_name="r_014.png")) == ("r_014", 0)

    def test_a_time_between_frames_is_refused(self) -> None:
        assert frame_of_time(0.06, 50, first=10) == 13
        refuses(r"time 0.0333333 is frame 1.67 of 50", frame_of_time, 1 / 30, 50)

    def test_cameras_without_names_are_found_by_their_pose(self) -> None:
        poses = {view.camera: view.T_camera_world for view in make_views() if view.frame == 0}
        keys = KeysByPose(poses, lambda camera: round(2 * camera.timestamp))
        camera = cameras_of(timestamp=lambda view: view.time)[5]
        assert keys(camera) == ("cam2", 1)
        camera.world_view_transform = camera.world_view_transform + 0.5
        refuses("stands at none of the known poses", keys, camera)

    def test_the_index_that_hust_calls_a_name_leads_to_the_path(self) -> None:
        model, scene = hust4d.make()
        adapter = Hust4DAdapter(model, scene, "fine")
        assert [(adapter.view(c).camera, adapter.view(c).frame) for c in scene.cameras] == [
            (view.camera, view.frame) for view in make_views()
        ]

        infos = [SimpleNamespace(image_path=path) for path in scene.train_camera.dataset.image_paths]
        listed = SimpleNamespace(train_camera=SimpleNamespace(dataset=infos))
        assert Hust4DAdapter(model, listed, "fine").view(scene.cameras[4]).camera == "cam1"

    def test_the_timestamp_of_ex4dgs_is_no_frame_number(self) -> None:
        """It starts at 0 wherever the clip starts, and padding mirrors it."""
        model, scene = ex4dgs.make()
        camera = scene.cameras[4]
        camera.timestamp = -1
        view = Ex4DGSAdapter(model, first_frame=100).view(camera)
        assert (view.camera, view.frame, view.time) == ("cam1", 101, -1.0)

    @pytest.mark.parametrize(("adapter", "fields", "key"), READERS)
    def test_what_every_reader_hands_out(self, adapter: str, fields: dict, key: tuple[str, int]) -> None:
        assert VARIANTS[adapter]().adapter.prior_key(SimpleNamespace(**fields)) == key

    def test_hypernerf_of_hust_says_the_folder_and_the_file_apart(self) -> None:
        """scene/hyper_loader.py:165; its order of training images is another than that of all images."""
        files = [SimpleNamespace(image_path="/data/vrig/rgb/2x", image_name=f"left1_00000{i}.png") for i in (7, 9)]
        scene = SimpleNamespace(train_camera=SimpleNamespace(dataset=files))
        adapter = Hust4DAdapter(hust4d.make()[0], scene, "fine")
        assert adapter.prior_key(SimpleNamespace(uid=1, image_name="1")) == ("left1", 9)

    def test_a_key_of_ones_own_goes_before_everything(self) -> None:
        model, scene = fudan.make()
        view = FudanAdapter(model, key=lambda camera: PriorKey("mine", 9)).view(scene.train_cameras[1.0][0])
        assert (view.camera, view.frame) == ("mine", 9)
