"""A prior made for another camera is refused with both values; a world that was only moved is not."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tiny import TinyStore, make_views
from torch import Tensor

from d2_plugin import D2Error
from d2_plugin.hooks import PriorLoader
from d2_plugin.protocol import CameraRecord, View


class RecordingStore(TinyStore):
    """The exact prior, with the cameras it was made for."""

    def camera(self, camera: str, frame: int) -> CameraRecord:
        view = next(v for v in make_views() if (v.camera, v.frame) == (camera, frame))
        return CameraRecord(view.K.double(), view.T_camera_world.double())


def load_all(change) -> None:
    loader = PriorLoader(RecordingStore())
    for view in make_views():
        loader(change(view))


def moved(view: View, motion: Tensor) -> View:
    return replace(view, T_camera_world=view.T_camera_world @ motion)


def test_the_cameras_it_was_built_for_are_accepted() -> None:
    load_all(lambda view: view)


def test_a_world_turned_and_shifted_as_a_whole_changes_no_depth() -> None:
    angle = torch.tensor(0.7)
    motion = torch.eye(4)
    motion[:2, :2] = torch.tensor([[angle.cos(), -angle.sin()], [angle.sin(), angle.cos()]])
    motion[:3, 3] = torch.tensor([5.0, -3.0, 11.0])
    load_all(lambda view: moved(view, motion))


def test_a_world_of_another_scale_is_refused_with_both_positions() -> None:
    def scaled(view: View) -> View:
        pose = view.T_camera_world.clone()
        pose[:3, 3] *= 2
        return replace(view, T_camera_world=pose)

    with pytest.raises(D2Error, match=r"camera at \(0.4, .*as seen from cam0 but the view is at \(0.8, .*scaled"):
        load_all(scaled)


def test_a_pose_that_is_sloppily_orthonormal_is_no_other_pose() -> None:
    def sloppy(view: View) -> View:
        pose = view.T_camera_world.clone()
        pose[0, 0] += 2e-4 * (view.camera == "cam1")
        return replace(view, T_camera_world=pose)

    load_all(sloppy)


def test_swapped_camera_names_are_refused() -> None:
    names = {"cam0": "cam0", "cam1": "cam2", "cam2": "cam1"}
    with pytest.raises(D2Error, match="the key names another camera"):
        load_all(lambda view: replace(view, camera=names[view.camera]))


def test_other_intrinsics_are_refused_with_both_values() -> None:
    def zoomed(view: View) -> View:
        return replace(view, K=view.K * torch.tensor([1.05, 1.05, 1.0])[:, None])

    with pytest.raises(D2Error, match=r"focal lengths \(30, 30\) but the view has \(31.5, 31.5\)"):
        load_all(zoomed)

    def shifted(view: View) -> View:
        K = view.K.clone()
        K[0, 2] += 2
        return replace(view, K=K)

    with pytest.raises(D2Error, match=r"principal point \(16, 12\) but the view has \(18, 12\)"):
        load_all(shifted)
