"""What a scene does not need is left out, with the measurement that says so."""

from __future__ import annotations

import pytest

from d2_plugin.captures import open_capture, select_frames
from d2_plugin.captures.synthetic.room import synthetic_capture
from d2_plugin.runs.plan import changed_share, plan_scene


@pytest.fixture(scope="module")
def moving():
    return synthetic_capture(cameras=3, frames=4, width=96, height=54)


def test_motion_keeps_the_temporal_dimension(moving) -> None:
    assert plan_scene(moving, ["train0", "train1"], "maps").uses("temporal")


def test_no_motion_leaves_the_temporal_dimension_out() -> None:
    still = synthetic_capture(cameras=2, frames=4, width=96, height=54, moving=False)
    plan = plan_scene(still, ["train0", "train1"], "maps")
    assert not plan.uses("temporal")
    assert changed_share(still, "train0") == 0


def test_one_instant_leaves_the_temporal_dimension_out(moving) -> None:
    plan = plan_scene(select_frames(moving, [2]), ["train0", "train1"], "maps")
    assert plan.as_dict()["temporal"] == {"use": False, "reason": "one instant"}


def test_one_camera_has_no_stereo_and_no_verification(moving) -> None:
    plan = plan_scene(moving, ["train0"], "maps")
    assert not plan.uses("stereo")
    assert not plan.uses("verification")


def test_without_monocular_depth_nothing_is_verified_by_it(moving) -> None:
    plan = plan_scene(moving, ["train0", "train1"], None)
    assert plan.uses("stereo")
    assert not plan.uses("monocular")
    assert not plan.uses("verification")


def test_a_user_may_decide_otherwise_and_the_plan_says_so(moving) -> None:
    plan = plan_scene(moving, ["train0", "train1"], "maps").override(temporal=False, stereo=None)
    assert not plan.uses("temporal")
    assert plan.uses("stereo")
    assert "overridden by the user (measured: motion" in plan.as_dict()["temporal"]["reason"]


def test_the_real_one_instant_capture_has_no_temporal_dimension(shared_data) -> None:
    capture = open_capture(shared_data("n3dv_sear_steak_t0"))
    assert not plan_scene(capture, ["cam03", "cam05"], None).uses("temporal")


def test_the_real_moving_capture_has_one(shared_data) -> None:
    capture = open_capture(shared_data("pose2sim_single"), frames=[0, 20, 40])
    assert plan_scene(capture, ["cam01", "cam02"], None).uses("temporal")
