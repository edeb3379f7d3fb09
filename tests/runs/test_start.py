"""From a recording to views, images and the points that Gaussians start from."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from prior_cases import world_points

from d2_plugin.priors.geometry import projected
from d2_plugin.protocol import DepthPrior, Label
from d2_plugin.recordings.cameras.camera import look_at
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.start import FROM_STEREO, TimedPoints, TrainingFrames, initial_points, scene_extent, with_stereo

CAMERAS = ("train0", "train1")


@pytest.fixture(scope="module")
def recording():
    return synthetic_recording(cameras=2, frames=3, width=96, height=54, fps=10)


def surface_points(recording, count: int) -> np.ndarray:
    points = world_points(recording.cameras["train0"], recording.depth("train0", 0))
    return points[np.linspace(0, len(points) - 1, count).astype(int)]


def test_kept_images_do_not_grow_with_the_number_of_frames(recording, monkeypatch: pytest.MonkeyPatch) -> None:
    image = 96 * 54 * 3
    monkeypatch.setattr("d2_plugin.runs.start.KEPT_IMAGES", 2 * image)
    frames = TrainingFrames(recording, CAMERAS)
    for index in range(len(frames.views)):
        image = frames.image(index)
        assert image.shape == (54, 96, 3)
        assert len(frames._kept) <= 2
    view = frames.views[0]
    assert torch.equal(frames.image(0), torch.from_numpy(recording.image(view.camera, view.frame)).float() / 255)


def test_extent_comes_from_points_where_there_are_enough(recording) -> None:
    extent = scene_extent(recording, CAMERAS, surface_points(recording, 500))
    depth = recording.depth("train0", 0)
    assert extent.near < np.percentile(depth, 5)
    assert extent.far > np.percentile(depth, 95)
    assert 0.3 < extent.radius / (0.5 * np.median(depth)) < 3


def test_a_handful_of_triangulated_points_leaves_the_extent_to_stereo(recording) -> None:
    surface = surface_points(recording, 500)
    handful = surface_points(recording, 6)
    handful[:] = recording.cameras["train0"].world(np.array([[48.0, 27.0]]), np.array([0.5]))  # all on one near thing
    assert scene_extent(recording, CAMERAS, handful, surface) == scene_extent(recording, CAMERAS, surface)
    alone = scene_extent(recording, CAMERAS, handful, np.zeros((0, 3)))
    assert alone == scene_extent(recording, CAMERAS, handful), "better than nothing"


def test_without_points_the_extent_is_where_the_cameras_look(recording) -> None:
    """Cameras all around a person: twice the spread of such a rig is far more than what it sees."""
    around = {}
    for place, angle in enumerate(np.radians([0, 100, 230])):
        centre = np.array([3.5 * np.cos(angle), 3.5 * np.sin(angle), 0.0])
        camera = recording.cameras[CAMERAS[0]]
        around[str(place)] = replace(camera, T_camera_world=look_at(centre, np.zeros(3), np.eye(3)[2]), near_far=None)
    extent = scene_extent(replace(recording, cameras=around), tuple(around), np.zeros((0, 3)))
    assert extent.radius == pytest.approx(3.5 / 2)
    assert extent.near < 3.5 < extent.far


def test_extent_falls_back_to_declared_bounds_and_then_to_the_rig(recording) -> None:
    nothing = np.zeros((0, 3))
    declared = scene_extent(recording, CAMERAS, nothing)
    near = min(recording.cameras[name].near_far[0] for name in CAMERAS)
    assert declared.near == pytest.approx(0.8 * near)
    bare = {name: replace(camera, near_far=None) for name, camera in recording.cameras.items()}
    from_rig = scene_extent(replace(recording, cameras=bare), CAMERAS, nothing)
    assert 0 < from_rig.near < from_rig.far
    single = scene_extent(replace(recording, cameras=bare), CAMERAS[:1], nothing)
    assert 0 < single.near < single.far


def test_too_few_points_are_filled_up_inside_the_views(recording) -> None:
    points = surface_points(recording, 50)
    sparse = TimedPoints(points, np.full((50, 3), 0.5), np.zeros(50))
    extent = scene_extent(recording, CAMERAS, points)
    start = initial_points(recording, CAMERAS, sparse, extent, minimum=400)
    positions, _, _ = start.tensors()
    assert positions.shape == (400, 3)
    assert torch.equal(positions[:50], torch.tensor(points, dtype=torch.float32))
    assert ((start.colors >= 0) & (start.colors <= 1)).all()
    assert (start.times <= 0.2).all()
    for name, rows in (("train0", slice(50, 225)), ("train1", slice(225, 400))):
        _, depths, inside = projected(recording.cameras[name], start.positions[rows])
        assert inside.all()
        assert ((depths > 0.99 * extent.near) & (depths < 1.01 * extent.far)).all()


def test_what_one_camera_alone_sees_begins_at_the_depth_of_what_stands_around_it(recording) -> None:
    points = surface_points(recording, 300)
    extent = scene_extent(recording, CAMERAS, points)

    def begin(known: int, cameras: tuple[str, ...] = CAMERAS) -> np.ndarray:
        sparse = TimedPoints(points[:known], np.full((known, 3), 0.5), np.zeros(known))
        return initial_points(recording, cameras, sparse, extent, minimum=known + 400).positions[known:]

    drawn, placed = begin(50), begin(300)  # the former are too few to say anything
    for own, other, rows in (("train0", "train1", slice(0, 200)), ("train1", "train0", slice(200, 400))):
        before, after = (projected(recording.cameras[own], some[rows]) for some in (drawn, placed))
        alone = ~projected(recording.cameras[other], drawn[rows])[2]
        assert alone.any()
        assert not alone.all()
        np.testing.assert_allclose(after[0], before[0], atol=1e-9)  # on the ray of its pixel as before
        np.testing.assert_array_equal(placed[rows][~alone], drawn[rows][~alone])
        _, depths, inside = projected(recording.cameras[own], points)
        apart = np.abs(after[1][alone][:, None] / depths[inside][None] - 1)
        np.testing.assert_allclose(apart.min(1), 0, atol=1e-12)
    np.testing.assert_array_equal(begin(50, CAMERAS[:1]), begin(300, CAMERAS[:1]))  # one camera: no second opinion


def test_a_run_that_inserts_starts_on_what_stereo_verified(recording) -> None:
    """As many pixels of each view, on the surface, in their colours, at their instant; none that was not verified."""
    sparse = TimedPoints(surface_points(recording, 50), np.full((50, 3), 0.5), np.zeros(50))
    labels = torch.full((54, 96), int(Label.MONO), dtype=torch.uint8)
    labels[:, :60] = Label.VERIFIED

    def prior(camera: str, frame: int) -> DepthPrior | None:
        return None if frame == 1 else DepthPrior(torch.from_numpy(recording.depth(camera, frame)), labels)

    assert len(with_stereo(sparse, recording, CAMERAS, prior, most=40)) == 50 + 4 * (40 // 6)
    start = with_stereo(sparse, recording, CAMERAS, prior)
    share = FROM_STEREO // 6  # three frames of two cameras
    assert len(start) == 50 + 4 * share
    assert np.array_equal(start.positions[:50], sparse.positions)
    for part, (frame, camera) in enumerate(itertools.product((0, 2), CAMERAS)):
        mine = slice(50 + part * share, 50 + (part + 1) * share)
        pixels, depths, _ = projected(recording.cameras[camera], start.positions[mine])
        columns, rows = np.round(pixels - 0.5).astype(int).T
        np.testing.assert_allclose(depths, recording.depth(camera, frame)[rows, columns], rtol=1e-5)
        np.testing.assert_array_equal(start.colors[mine], recording.image(camera, frame)[rows, columns] / 255)
        assert set(start.times[mine]) == {recording.seconds(frame)}
        assert columns.max() == 59
        assert len({*zip(rows, columns)}) == share


@pytest.mark.parametrize(("belief", "reach"), [("all", 80), ("stereo", 60), ("nothing", 0)])
def test_a_run_starts_on_what_is_believed(recording, belief, reach) -> None:
    """What two sources agree on where the prior is believed; not where trials found that the network is of no use."""
    labels = torch.full((54, 96), int(Label.MONO), dtype=torch.uint8)
    labels[:, :60], labels[:, 60:80] = Label.VERIFIED, Label.AGREED
    depth = torch.from_numpy(recording.depth(CAMERAS[0], 0))
    none = TimedPoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    start = with_stereo(none, recording, CAMERAS[:1], lambda *_: DepthPrior(depth, labels), belief)
    pixels = projected(recording.cameras[CAMERAS[0]], start.positions)[0]
    assert (int(np.floor(pixels[:, 0].max())) + 1 if len(start) else 0) == reach
