"""A prior made for another camera is refused with both values; a world that was only moved is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from tiny import TinyStore, make_views

from d2_plugin import D2Error
from d2_plugin.hooks import PriorLoader
from d2_plugin.protocol import CameraRecord, View


class RecordingStore(TinyStore):
    """The exact prior, with the cameras it was made for."""

    def camera(self, camera: str, frame: int) -> CameraRecord:
        view = next(v for v in make_views() if (v.camera, v.frame) == (camera, frame))
        return CameraRecord(view.K.double(), view.T_camera_world.double())


def load_all(change: Callable[[View], View]) -> None:
    loader = PriorLoader(RecordingStore())
    for view in make_views():
        loader(change(view))


def unchanged(view: View) -> View:
    return view


def turned_and_shifted(view: View) -> View:
    angle, motion = torch.tensor(0.7), torch.eye(4)
    motion[:2, :2] = torch.tensor([[angle.cos(), -angle.sin()], [angle.sin(), angle.cos()]])
    motion[:3, 3] = torch.tensor([5.0, -3.0, 11.0])
    return replace(view, T_camera_world=view.T_camera_world @ motion)


def sloppily_orthonormal(view: View) -> View:
    pose = view.T_camera_world.clone()
    pose[0, 0] += 2e-4 * (view.camera == "cam1")
    return replace(view, T_camera_world=pose)


def scaled(view: View) -> View:
    pose = view.T_camera_world.clone()
    pose[:3, 3] *= 2
    return replace(view, T_camera_world=pose)


def swapped(view: View) -> View:
    return replace(view, camera={"cam0": "cam0", "cam1": "cam2", "cam2": "cam1"}[view.camera])


def zoomed(view: View) -> View:
    return replace(view, K=view.K * torch.tensor([1.05, 1.05, 1.0])[:, None])


def shifted_image(view: View) -> View:
    K = view.K.clone()
    K[0, 2] += 2
    return replace(view, K=K)


@pytest.mark.parametrize("change", [unchanged, turned_and_shifted, sloppily_orthonormal])
def test_what_changes_no_depth_is_accepted(change: Callable[[View], View]) -> None:
    load_all(change)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (scaled, r"camera at \(0.4, .*as seen from cam0 but the view is at \(0.8, .*scaled"),
        (swapped, "the key names another camera"),
        (zoomed, r"focal lengths \(30, 30\) but the view has \(31.5, 31.5\)"),
        (shifted_image, r"principal point \(16, 12\) but the view has \(18, 12\)"),
    ],
)
def test_another_camera_is_refused_with_both_values(change: Callable[[View], View], says: str) -> None:
    with pytest.raises(D2Error, match=says):
        load_all(change)
