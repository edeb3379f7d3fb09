"""The traps of the official repositories, one by one: names, fields of view, batches, stages, probes, boxes."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from mimics import deformable3d, ex4dgs, fudan, hust4d, spacetime
from mimics.inria import Camera, cameras_of, default_options
from mimics.workplace import HOOKS, some_points
from rasterizer_arguments import inria_camera
from refusals import refuses
from repositories import VARIANTS, fudan_model
from tiny import TinyStore, make_views
from torch import Tensor

from d2_plugin import D2Config, D2Hooks
from d2_plugin.adapters.cameras import intrinsics
from d2_plugin.adapters.deformable3d import Deformable3DAdapter
from d2_plugin.adapters.ex4dgs import Ex4DGSAdapter
from d2_plugin.adapters.fudan import FudanAdapter
from d2_plugin.adapters.hust4d import Hust4DAdapter
from d2_plugin.adapters.keys import KeysByPose, PriorKey, frame_of_time, key_from_image_name, one_image_each
from d2_plugin.adapters.spacetime import SpacetimeAdapter
from d2_plugin.adapters.successors.fastergs4d import FasterGS4DAdapter
from d2_plugin.compat import fourd
from d2_plugin.config import DepthLossConfig
from d2_plugin.protocol import Points

DEPTH_ALONE = D2Config(depth_loss=DepthLossConfig(every=1))


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
    ("ex4dgs", {"image_path": "/d/Painter/Painter_undist_00151_10.png", "image_name": "-"}, ("10", 151)),
]


class TestNames:
    """Which camera and frame of the prior a trainer's camera object stands for."""

    def test_a_moving_camera_has_a_prior_for_each_image_and_no_camera_or_a_time_between_frames_is_refused(self) -> None:
        refuses(r"image '0003.png' does not say its camera.*function `key`", key_from_image_name, "0003.png")
        assert one_image_each(SimpleNamespace(image_name="r_014.png")) == ("r_014", 0)
        assert frame_of_time(0.06, 50, first=10) == 13
        refuses(r"time 0.0333333 is frame 1.67 of 50", frame_of_time, 1 / 30, 50)

    def test_cameras_without_names_are_found_by_their_pose(self) -> None:
        poses = {view.camera: view.T_camera_world for view in make_views() if view.frame == 0}
        keys = KeysByPose(poses, lambda camera: round(2 * camera.timestamp))
        camera = cameras_of(timestamp=lambda view: view.time)[5]
        assert keys(camera) == ("cam2", 1)
        camera.timestamp += 1  # one object that goes through time
        assert keys(camera) == ("cam2", 3)
        camera.world_view_transform = camera.world_view_transform + 0.5
        refuses("stands at none of the known poses", keys, camera)

    def test_the_index_that_hust_calls_a_name_leads_to_the_path(self) -> None:
        model, scene = hust4d.make()
        adapter = Hust4DAdapter(model, scene, "fine")
        seen, expected = map(adapter.view, scene.cameras), make_views()
        assert [(view.camera, view.frame) for view in seen] == [(view.camera, view.frame) for view in expected]
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


class TestFieldsOfView:
    def test_intrinsics_come_from_the_projection_even_off_centre(self) -> None:
        K = make_views()[0].K.clone()
        K[0, 2], K[1, 2] = 14.5, 13.0
        moved = Camera(replace(make_views()[0], K=K), torch.zeros(24, 32, 3), FoVx=-1.0, FoVy=-1.0)
        torch.testing.assert_close(intrinsics(moved, 32, 24).float(), K)

    def test_a_camera_without_a_projection_is_refused(self) -> None:
        camera = cameras_of()[0]
        camera.projection_matrix = None
        refuses("has no projection_matrix: pass the trainer's own", FudanAdapter(fudan.make()[0]).view, camera)

    def test_minus_one_is_corrected_where_a_hook_is_on_and_left_alone_where_none_is(self) -> None:
        for config, corrected in ((D2Config(), False), (DEPTH_ALONE, True)):
            model, scene = self.scene_with_focal_lengths()
            D2Hooks(config, FudanAdapter(model, scene), TinyStore())
            angle = 2 * math.atan(32 / (2 * 30.0)) if corrected else -1.0
            assert [camera.FoVx for camera in scene.train_cameras[1.0]] == pytest.approx([angle] * 6)
        model, scene = self.scene_with_focal_lengths()
        D2Hooks(DEPTH_ALONE, FudanAdapter(model, scene, correct_fov=False), TinyStore())
        assert scene.train_cameras[1.0][0].FoVx == -1

    def test_minus_one_that_cannot_be_corrected_is_named_once(self, caplog: pytest.LogCaptureFixture) -> None:
        model, scene = self.scene_with_focal_lengths()
        adapter = FudanAdapter(model)
        for camera in scene.train_cameras[1.0]:
            adapter.view(camera)
        assert caplog.text.count("has a field of view of -1") == 1

    @staticmethod
    def scene_with_focal_lengths():
        model, scene = fudan.make()
        for camera in scene.train_cameras[1.0]:
            camera.FoVx = camera.FoVy = -1.0
            camera.fl_x = camera.fl_y = 30.0
        return model, scene


class TestFudan:
    @pytest.mark.parametrize("prefilter_var", [0.04, -1.0])
    @pytest.mark.parametrize("rot_4d", [True, False])
    def test_the_variants_of_the_temporal_marginal(self, rot_4d: bool, prefilter_var: float) -> None:
        """F(t) = exp(-dt^2 / 2 v) with v + prefilter_var, where v is exp(_scaling_t) itself without rot_4d."""
        model, _ = fudan_model(rot_4d=rot_4d, prefilter_var=prefilter_var)
        view = make_views()[0]
        splats = FudanAdapter(model).slice_at(view)
        scale = model._scaling_t[:, 0].exp()
        variance = (scale**2 if rot_4d else scale) + max(prefilter_var, 0)
        marginal = torch.exp(-0.5 * (view.time - model._t[:, 0]) ** 2 / variance)
        rows = torch.nonzero(marginal > 0.05).squeeze(1)
        assert torch.equal(splats.rows, rows)
        torch.testing.assert_close(splats.opacities, (model.get_opacity[:, 0] * marginal)[rows])

    def test_three_dimensional_models_and_forks_without_a_prefilter(self) -> None:
        model, _ = fudan_model(gaussian_dim=3)
        assert len(FudanAdapter(model).slice_at(make_views()[0]).rows) == 60
        model, _ = fudan_model()
        del model.prefilter_var
        assert len(FudanAdapter(model).slice_at(make_views()[0]).rows) > 0

    @pytest.mark.parametrize("degree", [2, 3])
    def test_colours_are_those_of_the_cuda_source(self, degree: int) -> None:
        """Seen along the ray to where a Gaussian is at its own time, and constant in time below the third degree."""
        shs, view = torch.randn(60, 52, 3, generator=torch.Generator().manual_seed(0)), make_views()[4]
        model, _ = fudan_model(active_sh_degree=degree, active_sh_degree_t=2, force_sh_3d=False)
        model._features_dc, model._features_rest, turn = shs.split([1, 47, 4], 1)
        model._rotation_r.data += 0.5 * turn[..., 0]  # so that they move
        camera = inria_camera(view) | {"sh_degree": degree, "sh_degree_t": 2, "gaussian_dim": 4, "timestamp": view.time}
        settings = fourd.GaussianRasterizationSettings(**camera, time_duration=model.time_duration[1])
        splats = (adapter := FudanAdapter(model)).slice_at(view)
        expected = fourd.GaussianRasterizer(settings)._colors(shs, model._xyz, model._t, splats.rows)
        torch.testing.assert_close(adapter.colors(view, splats), expected)
        assert not torch.allclose(splats.means, model._xyz[splats.rows], atol=0.1)

    def test_points_that_are_not_finite_are_never_inserted(self) -> None:
        model, _ = fudan_model()
        points = some_points(4)
        points.positions[0, 0], points.scales[1], points.scales[2] = math.nan, math.inf, 0.0
        assert FudanAdapter(model).insert(points) == 1


class TestDeformations:
    def test_before_the_warm_up_nothing_is_deformed_and_hooks_may_wait_for_it(self) -> None:
        model, deform, _ = deformable3d.make()
        adapter = Deformable3DAdapter(model, deform, warm_up=30)
        adapter.begin_step(29)
        assert torch.equal(adapter.slice_at(make_views()[0]).means, model._xyz)
        assert adapter.active(1)
        adapter.begin_step(30)
        assert not torch.equal(adapter.slice_at(make_views()[0]).means, model._xyz)
        waiting = Deformable3DAdapter(model, deform, warm_up=30, in_warm_up=False)
        assert [waiting.active(step) for step in (1, 29, 30)] == [False, False, True]

    def test_points_outside_the_grid_of_4dgaussians_are_left_out(self) -> None:
        model, scene = hust4d.make()
        model.training_setup(default_options())
        points = some_points(5)
        points.positions[:2] += 100.0
        assert Hust4DAdapter(model, scene, "fine").insert(points) == 3
        assert len(model._deformation_table) == len(model._xyz) == 63

    def test_the_coarse_stage_is_left_alone_unless_asked(self) -> None:
        model, scene = hust4d.make()
        model.training_setup(default_options())
        d2 = D2Hooks(HOOKS, Hust4DAdapter(model, scene, "coarse"), TinyStore())
        assert d2.loss(10, scene.cameras[:2]) == 0.0
        assert d2.step(10).inserted == 0
        eager = D2Hooks(HOOKS, Hust4DAdapter(model, scene, "coarse", active_stages=("coarse", "fine")), TinyStore())
        assert isinstance(eager.loss(10, scene.cameras[:2]), Tensor)
        refuses("stage of scene_reconstruction 'medium': have coarse, fine", Hust4DAdapter, model, scene, "medium")


def test_another_codebase_than_the_adapters_is_refused() -> None:
    model = SimpleNamespace(_xyz=torch.zeros(3, 3), _spatial_means=torch.zeros(1, 3))
    refuses("SimpleNamespace has no densification_postfix, which FudanAdapter needs", FudanAdapter, model)
    refuses("SimpleNamespace has no prune, which FasterGS4DAdapter needs", FasterGS4DAdapter, model)


def test_what_is_no_camera_of_the_codebase_is_refused() -> None:
    keyed = FudanAdapter(fudan.make()[0], key=lambda camera: PriorKey("a", 0))
    refuses("a camera of type dict has no world_view_transform", keyed.view, {})
    refuses("a camera of type dict is no View", VARIANTS["gsplat"]().adapter.view, {})
    refuses("a camera of type dict has no perspective `camera`", VARIANTS["fastergs4d"]().adapter.view, {})


def test_points_inside_spacetime_have_its_own_start() -> None:
    model, _ = spacetime.make()
    model.training_setup(default_options())
    SpacetimeAdapter(model, 2).insert(Points(*(value for value in some_points(2))))
    assert model._trbf_center[-1].item() == 0.5
    assert model._trbf_scale[-1].item() == pytest.approx(model.trbfslinit)
    torch.testing.assert_close(model._features_dc[-2:], some_points(2).colors.repeat(1, 2))


@pytest.mark.parametrize("name", ["fudan", "spacetime"])
def test_a_lifetime_is_the_standard_deviation_in_time(name: str) -> None:
    """One lifetime away from its instant exp(-1/2) of the opacity is left; a long one leaves the repository's start."""
    adapter, brief = VARIANTS[name]().adapter, 0.02
    count = len(adapter)
    view = replace(make_views()[0], time=0.5)
    adapter.insert(some_points(2)._replace(lifetimes=torch.tensor([brief, torch.inf])))

    def left(time: float) -> torch.Tensor:
        splats = adapter.slice_at(replace(view, time=time))
        return torch.stack([splats.opacities[splats.rows == count + i].sum() for i in range(2)]).detach()

    now, later = left(0.5), left(0.5 + brief)
    assert (later / now)[0].item() == pytest.approx(math.exp(-0.5), abs=1e-3)
    assert (later / now)[1].item() > 0.9


def test_without_rotation_in_time_fudan_keeps_the_log_of_a_variance() -> None:
    model, _ = fudan_model()
    adapter, rows = FudanAdapter(model), []
    model.rot_4d, model.densification_postfix = False, lambda *columns: rows.extend(columns)
    adapter._append(some_points(1)._replace(lifetimes=torch.tensor([0.02])))
    torch.testing.assert_close(rows[7].exp().sqrt(), torch.tensor([[0.02]]))
    assert rows[8] is None


def test_attaching_again_takes_the_place_of_the_first() -> None:
    """Stages of one run attach to one model more than once."""
    model, scene = hust4d.make()
    model.training_setup(default_options())
    reports: list[str] = []
    for stage in ("coarse", "fine"):
        adapter = Hust4DAdapter(model, scene, stage)
        adapter.on_resize(lambda index, stage=stage: reports.append(stage))
    adapter.insert(some_points(2))
    assert reports == ["fine"]
    adapter.detach()
    assert "prune_points" not in vars(model)
