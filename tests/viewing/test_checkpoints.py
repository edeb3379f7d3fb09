"""Checkpoints of official trainers are shown as their own code draws them, and none of that code is run."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from mimics import fudan, hust4d, spacetime, swift4d
from mimics.inria import default_options
from oracles.export_files import ReadPage
from refusals import refuses
from torch import Tensor
from viewing import official

from d2_plugin import registry
from d2_plugin.adapters.fudan import FudanAdapter
from d2_plugin.adapters.spacetime import SpacetimeAdapter
from d2_plugin.commands.cli import main
from d2_plugin.protocol import View
from d2_plugin.viewing.checkpoints import open_viewed
from d2_plugin.viewing.checkpoints.files import read_options, read_ply
from d2_plugin.viewing.checkpoints.models import FOUR_C, FOUR_C_STATIC, FUDAN, PLANES, STATIC
from d2_plugin.viewing.checkpoints.networks import MotionNetwork, PlaneField
from d2_plugin.viewing.live.show import ViewSettings, viewed_at
from d2_plugin.viewing.rendering import render_view
from d2_plugin.viewing.viewed import ViewedRun

SIZE = (96, 54)


def seen(viewed: ViewedRun, time: float, camera: str = "train0") -> Any:
    """The viewed's view of a camera of the recording."""
    return viewed.view(viewed.recording.cameras[camera], time, SIZE)


def close(a: Tensor, b: Any, within: float = 2e-5) -> bool:
    return torch.allclose(a, torch.as_tensor(b, dtype=a.dtype), atol=within, rtol=1e-5)


class TestTuples:
    @staticmethod
    def checkpoint(path: Path, layout: tuple[str, ...] = FUDAN) -> fudan.GaussianModel:
        """A checkpoint as fudan and 4C4D save it, its extent a number of numpy's."""
        model, _ = fudan.make()
        values = {name: getattr(model, name, None) for name in layout} | {"active_sh_degree": 0}
        values |= {"spatial_lr_scale": np.float32(2.0), "optimizer": {"state": {}, "param_groups": []}}
        if "rot_4d" in layout:
            values |= {"rot_4d": True, "active_sh_degree_t": 0}
        if "coefficient" in layout:
            values |= {"coef_optimizer": {"state": {}}, "coefficient": {"layer.weight": torch.ones(2, 2)}}
        torch.save((tuple(values.values()), 30000), path)
        return model

    @pytest.mark.parametrize("layout", [FUDAN, FOUR_C], ids=["fudan", "4C4D"])
    def test_4d_gaussians_are_shown_as_their_adapter_slices_them(self, room, tmp_path, layout) -> None:
        model = self.checkpoint(tmp_path / "chkpnt30000.pth", layout)
        found = open_viewed(tmp_path / "chkpnt30000.pth", room, ["train0", "train1"])
        assert found.test_cameras == ("train2", "test0")
        view = seen(found, 0.1)
        assert torch.equal(render_view(found.backbone, view).color, render_view(FudanAdapter(model), view).color)
        assert found.note == "times are taken to be seconds since the first frame"
        refuses("name its recording with --recording", open_viewed, tmp_path / "chkpnt30000.pth")

    @pytest.mark.parametrize("layout", [STATIC, FOUR_C_STATIC], ids=["3DGS", "4C4D without time"])
    def test_without_time_they_stand_still(self, room: Path, tmp_path: Path, layout: tuple[str, ...]) -> None:
        self.checkpoint(tmp_path / "chkpnt7000.pth", layout)
        found = open_viewed(tmp_path / "chkpnt7000.pth", room)
        assert found.note == "3D Gaussians stand still"
        early, late = (found.backbone.slice_at(seen(found, time)) for time in (0.0, 0.2))
        assert torch.equal(early.means, late.means)

    @pytest.mark.parametrize("core", [b"numpy.core", b"numpy._core"])
    def test_the_extent_is_a_number_of_any_numpy(self, room: Path, tmp_path: Path, core: bytes) -> None:
        """The repositories pin numpy 1, whose numbers carry another module's name."""
        path = tmp_path / "chkpnt1.pth"
        self.checkpoint(path)
        whole = torch.load(path, weights_only=False)
        torch.save(whole, path, _use_new_zipfile_serialization=False)  # without checksums of its parts
        own = np.float32(0).__reduce__()[0].__module__.encode() + b"\n"
        assert own in path.read_bytes()
        path.write_bytes(path.read_bytes().replace(own, core + b".multiarray\n"))
        assert len(open_viewed(path, room).backbone)


class TestDeformable3D:
    """point_cloud/iteration_N/point_cloud.ply and deform/iteration_N/deform.pth."""

    @pytest.mark.parametrize("variant", list(official.DEFORMED))
    def test_the_network_is_the_repositorys_own(self, variant: str) -> None:
        network = MotionNetwork(official.motion_network(variant), Path("deform.pth"))
        found = network.step(official.POINTS, torch.full((3, 1), official.TIME))
        for told, true in zip(found, official.DEFORMED[variant], strict=True):
            assert close(told.flatten(1), true)

    @staticmethod
    def output(folder: Path, variant: str = "plain") -> dict[str, Tensor]:
        """What its train.py leaves after 20000 and 40000 iterations; the network of the earlier one is another's."""
        model = official.inria_columns(40)
        for iteration in (9000, 40000):
            official.write_inria_ply(folder / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply", model)
            weights = folder / "deform" / f"iteration_{iteration}" / "deform.pth"
            weights.parent.mkdir(parents=True)
            torch.save(official.motion_network(variant if iteration == 40000 else "is_blender"), weights)
        return model

    def test_its_output_folder_is_shown_at_the_last_iteration(self, room: Path, tmp_path: Path) -> None:
        model = self.output(tmp_path)
        found = open_viewed(tmp_path, room)
        half = found.duration / 2
        assert seen(found, half).time == pytest.approx(0.5)
        drawn = found.backbone.slice_at(seen(found, official.TIME * found.duration))
        means, rotations, scales = (torch.tensor(offsets) for offsets in official.DEFORMED["plain"])
        assert close(drawn.means[:3] - official.POINTS, means)
        # Offsets of scales come after exp. Quaternions are not normalised again, and of one whose length is not 1 the
        # columns of Inria's matrix are no unit vectors.
        w, x, y, z = (torch.nn.functional.normalize(model["_rotation"][:3]) + rotations).unbind(1)
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        turned = torch.stack([torch.stack(row, -1) for row in rows], 1)
        factors = turned * (model["_scaling"][:3].exp() + scales)[:, None]
        assert close(drawn.covariances[:3, [0, 3, 5]].sum(1), factors.square().sum((1, 2)), 1e-2)
        assert found.backbone.colors(seen(found, half), drawn).shape == (40, 3)

    def test_d2_view_takes_the_folder_for_a_checkpoint_and_not_for_a_recording(self, room: Path, tmp_path) -> None:
        self.output(tmp_path)
        assert len(viewed_at(ViewSettings(tmp_path, recording=room)).backbone) == 40
        refuses(r"point_cloud\.ply does not say where its cameras stood", viewed_at, ViewSettings(tmp_path))
        weights = tmp_path / "deform" / "iteration_40000" / "deform.pth"
        torch.save({"layer.weight": torch.zeros(3)}, weights)
        refuses(r"has no linear\.0\.weight: it is no network of Deformable-3D-Gaussians", open_viewed, tmp_path, room)
        weights.unlink()
        refuses("a point cloud of Deformable-3D-Gaussians moves by it, copy both", open_viewed, tmp_path, room)


class Test4DGaussians:
    """point_cloud/iteration_N/{point_cloud.ply, deformation.pth} with the options in cfg_args; chkpnt_fine_N.pth."""

    @pytest.mark.parametrize("name", list(official.BENT))
    def test_the_field_is_the_repositorys_own(self, name: str) -> None:
        changed, *true = official.BENT[name]
        options = official.OPTIONS | changed
        field = PlaneField(official.plane_field(changed.get("defor_depth", 1)), options, Path("deformation.pth"))
        *found, harmonics = field(official.POINTS, *official.RAW, torch.full((3, 1), official.TIME))
        for told, expected in zip([*found, harmonics[:, [0, 15]].flatten(1)], true, strict=True):
            assert close(told, expected)

    @staticmethod
    def output(folder: Path, **changed: Any) -> dict[str, Tensor]:
        """What its train.py leaves: the coarse stage at 3000 iterations, the fine one at 14000."""
        model = official.inria_columns(40)
        for stage in ("coarse_iteration_3000", "iteration_14000"):
            place = folder / "point_cloud" / stage
            official.write_inria_ply(place / "point_cloud.ply", model)
            torch.save(official.plane_field(changed.get("defor_depth", 1)), place / "deformation.pth")
            torch.save(torch.ones(40, dtype=torch.bool), place / "deformation_table.pth")
        (folder / "cfg_args").write_text(official.options_text(**changed))
        return model

    def test_its_output_folder_is_shown_as_the_field_moves_it(self, room: Path, tmp_path: Path) -> None:
        model = self.output(tmp_path)
        found = open_viewed(tmp_path, room)
        # Frame 2 of 4 is at its time 2 / 4: readers of several cameras divide by the number of frames.
        assert seen(found, found.recording.seconds(2)).time == pytest.approx(0.5)
        drawn = found.backbone.slice_at(seen(found, official.TIME * 4 / found.recording.fps))
        assert close(drawn.means[:3], official.BENT["as by default"][1])
        assert close(drawn.opacities, torch.sigmoid(model["_opacity"][:, 0]))

    def test_colours_are_deformed_where_the_options_say_so(self, room: Path, tmp_path: Path) -> None:
        colors = {}
        for name, still in (("still", True), ("deformed", False)):
            self.output(tmp_path / name, no_dshs=still)
            found = open_viewed(tmp_path / name, room)
            early, late = (seen(found, time) for time in (0.0, found.duration))
            means = found.backbone.slice_at(early)  # the same directions for both
            colors[name] = [found.backbone.colors(view, means) for view in (early, late)]
        assert torch.equal(*colors["still"])
        assert not torch.allclose(*colors["deformed"], atol=1e-2)

    def test_a_checkpoint_of_the_fine_stage_is_the_same(self, room: Path, tmp_path: Path) -> None:
        model = self.output(tmp_path) | {"deformation": official.plane_field(), "active_sh_degree": 3}
        values = [model.get(name, torch.zeros(1)) for name in PLANES]
        torch.save((tuple(values), 14000), tmp_path / "chkpnt_fine_14000.pth")
        both = [open_viewed(path, room) for path in (tmp_path, tmp_path / "chkpnt_fine_14000.pth")]
        views = [seen(found, 0.1) for found in both]
        images = [render_view(found.backbone, view) for found, view in zip(both, views, strict=True)]
        assert torch.equal(images[0].color, images[1].color)
        torch.save((tuple(values), 3000), tmp_path / "chkpnt_coarse_3000.pth")
        still = open_viewed(tmp_path / "chkpnt_coarse_3000.pth", room)
        assert close(still.backbone.slice_at(seen(still, 0.1)).means, model["_xyz"])

    def test_without_its_options_or_with_unknown_ones_it_is_refused(self, room: Path, tmp_path: Path) -> None:
        self.output(tmp_path, static_mlp=True)
        refuses(r"was trained with static_mlp.*Viewer\(d2\)", open_viewed, tmp_path, room)
        (tmp_path / "cfg_args").unlink()
        refuses(
            "cfg_args .*: copy it along with the point cloud, it says how the trainer was set",
            open_viewed,
            tmp_path,
            room,
        )

    def test_options_are_read_and_not_run(self, tmp_path: Path) -> None:
        path = tmp_path / "cfg_args"
        path.write_text(f"Namespace(no_do=True, bad=open({str(tmp_path / 'made')!r}, 'w'), name='</script>')")
        assert read_options(path) == {"no_do": True, "name": "</script>"}
        assert not (tmp_path / "made").exists()
        path.write_text("no options")
        refuses("cannot read .* as a list of options", read_options, path)


class TestClouds:
    def test_a_point_cloud_of_spacetime_gaussians_moves_with_the_recording(self, room: Path, tmp_path: Path) -> None:
        gaussians = spacetime.make()[0]
        gaussians._motion = 0.2 * torch.randn(gaussians._motion.shape, generator=torch.Generator().manual_seed(4))
        columns = official.places(gaussians._xyz) | official.columns_of(
            trbf_center=gaussians._trbf_center, trbf_scale=gaussians._trbf_scale, opacity=gaussians._opacity,
            motion=gaussians._motion, f_dc=gaussians._features_dc[:, :3], omega=gaussians._omega,
            scale=gaussians._scaling, rot=gaussians._rotation,
        )  # fmt: skip
        official.write_ply(tmp_path / "point_cloud.ply", columns)
        found = open_viewed(tmp_path / "point_cloud.ply", room)
        # Frame 2 of 4 is at the trainer's time 0.5.
        view = seen(found, found.recording.seconds(2))
        assert view.time == pytest.approx(0.5)
        expected = SpacetimeAdapter(gaussians, 4).slice_at(view)
        assert torch.allclose(found.backbone.slice_at(view).means, expected.means, atol=1e-6)
        assert torch.allclose(found.backbone.slice_at(view).opacities, expected.opacities, atol=1e-6)

    def test_a_point_cloud_is_shown_as_the_run_that_wrote_it(
        self, trained: Path, room: Path, viewed: ViewedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(viewed.backbone.model, "background", None)  # a point cloud has none
        assert main(["export", str(trained), "--format", "ply", "--frames", "0", "--output", str(tmp_path)]) == 0
        first = tmp_path / "ply" / "frame_00000.ply"
        found = open_viewed(first, room)
        view = seen(viewed, 0.0, "train1")
        assert (render_view(found.backbone, view).color - render_view(viewed.backbone, view).color).abs().max() < 0.02
        assert {"x", "opacity", "rot_3"} <= set(read_ply(first))

    def test_a_point_cloud_of_4c4d_has_its_time(self, room: Path, tmp_path: Path) -> None:
        model = fudan.make()[0]
        columns = official.places(model._xyz) | official.columns_of(
            opacity=model._opacity, f_dc=model._features_dc[:, 0], scale=model._scaling, rot=model._rotation,
            rot_r=model._rotation_r, t=model._t, scale_t=model._scaling_t,
        )  # fmt: skip
        official.write_ply(tmp_path / "point_cloud.ply", columns)
        found = open_viewed(tmp_path / "point_cloud.ply", room)
        for time in (0.0, 0.2):
            true, told = FudanAdapter(model).slice_at(seen(found, time)), found.backbone.slice_at(seen(found, time))
            assert close(told.means, true.means)
            assert close(told.opacities, true.opacities)

    def test_an_output_folder_of_3d_gaussians_is_its_last_point_cloud(self, room: Path, tmp_path: Path) -> None:
        for iteration, seed in ((7000, 1), (30000, 2)):
            place = tmp_path / "point_cloud" / f"iteration_{iteration}"
            official.write_inria_ply(place / "point_cloud.ply", official.inria_columns(9, seed))
        found = open_viewed(tmp_path, room)
        assert close(found.backbone.slice_at(seen(found, 0.1)).means, official.inria_columns(9, 2)["_xyz"])
        (tmp_path / "empty" / "point_cloud").mkdir(parents=True)
        refuses("has no iteration_N/point_cloud", open_viewed, tmp_path / "empty", room)


class Harm:
    """An object that does something when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return (Path.touch, (self.path,))


class TestRefused:
    @pytest.mark.parametrize(
        ("name", "trainer"), [("dynamic_point_cloud.ply", "Ex4DGS or CEM-4DGS"), ("FDHash.pth", "Swift4D")]
    )
    def test_the_still_part_of_a_model_is_not_shown_as_the_whole(self, room, tmp_path, name, trainer) -> None:
        place = tmp_path / "point_cloud" / "iteration_30000"
        official.write_inria_ply(place / "point_cloud.ply", official.inria_columns(9))
        (place / name).write_bytes(b"")
        refuses(rf"is of {trainer}, whose motion lies in {name}.*Viewer\(d2\)", open_viewed, tmp_path, room)

    def test_no_code_in_a_file_is_run(self, room: Path, tmp_path: Path) -> None:
        torch.save(((Harm(tmp_path / "made"),), 1), tmp_path / "chkpnt1.pth")
        (tmp_path / "ckpt_1.pt").write_bytes(pickle.dumps(Harm(tmp_path / "made")))
        TestDeformable3D.output(tmp_path / "def")
        torch.save(Harm(tmp_path / "made"), tmp_path / "def" / "deform" / "iteration_40000" / "deform.pth")
        for path in (tmp_path / "chkpnt1.pth", tmp_path / "ckpt_1.pt", tmp_path / "def"):
            refuses("cannot read .* as a checkpoint of tensors", open_viewed, path, room)
        assert not (tmp_path / "made").exists()

    def test_a_file_that_is_no_checkpoint(self, room: Path, tmp_path: Path, refused) -> None:
        path = tmp_path / "a.pth"
        path.write_bytes(b"nothing")
        refuses("cannot read .* as a checkpoint", open_viewed, path, room)
        torch.save({"weights": torch.zeros(3)}, path)
        refuses("is no checkpoint that can be shown", open_viewed, path, room)
        torch.save((tuple(range(40)), 1), path)
        refuses(r"has 40 entries, expected 19 \(fudan\), 21 \(4C4D\).*Viewer\(d2\)", open_viewed, path, room)
        (tmp_path / "a.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex -1\nend_header\n")
        refuses("it says -1 vertices", open_viewed, tmp_path / "a.ply", room)
        refused("render", path, "--recording", room)

    @pytest.mark.parametrize(
        ("name", "value", "said"),
        [
            ("_rotation", torch.zeros(60, 3), "cannot read checkpoint"),
            ("_scaling", torch.zeros(7, 3), "cannot read checkpoint"),
            ("_opacity", None, "cannot read checkpoint"),
            ("_xyz", torch.full((60, 3), torch.nan), "numbers that are not finite"),
        ],
    )
    def test_a_checkpoint_whose_tensors_do_not_fit_is_one_sentence(self, room, tmp_path, name, value, said) -> None:
        TestTuples.checkpoint(tmp_path / "a.pth", STATIC)
        values, step = torch.load(tmp_path / "a.pth", weights_only=False)
        values = [value if own == name else old for own, old in zip(STATIC, values, strict=True)]
        torch.save((tuple(values), step), tmp_path / "a.pth")
        refuses(said, open_viewed, tmp_path / "a.pth", room)


def test_an_exported_checkpoint_of_4d_gaussians_has_the_same_lines(room: Path, tmp_path: Path, answered) -> None:
    path = tmp_path / "chkpnt30000.pth"
    model = TestTuples.checkpoint(path)
    said = answered("export", str(path), "--recording", str(room), "--train-cameras", "train0,train1")
    assert "times are taken to be seconds since the first frame" in said
    assert "moves on a straight line and fades in time, exactly as it was trained" in said
    page = ReadPage(tmp_path / "export" / "scene.html")
    assert [camera["held_out"] for camera in page.header["cameras"]] == [False, False, True, True]
    for time in (0.0, 0.1, 0.25):
        true = FudanAdapter(model).slice_at(seen(open_viewed(path, room), time))
        told = page.at(time)
        drawn = told.positions[told.opacities >= 1 / 255]
        assert torch.cdist(true.means[true.opacities >= 1 / 255].double(), drawn).amin(1).max() < 1e-3


@pytest.mark.parametrize("name", ["hust4d", "swift4d"])
def test_live_colours_are_those_that_the_field_leaves(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Configurations for several cameras deform harmonics (no_dshs=False); Swift4D those of what moves alone."""
    model, scene = {"hust4d": hust4d, "swift4d": swift4d}[name].make()
    model.training_setup(default_options())
    adapter: Any = registry.load(registry.ADAPTERS, name)(model, scene, "coarse")
    view = View("a", 0, 0.2, torch.eye(4), torch.eye(3), 4, 4)
    splats = adapter.slice_at(view)
    before = adapter.colors(view, splats)
    adapter.enter_stage("fine")
    assert torch.equal(adapter.colors(view, splats), before), "this field leaves them alone"
    field = type(model._FDhash if name == "swift4d" else model._deformation)
    forward = field.forward

    def brighter(self: Any, *raw: Tensor) -> tuple[Tensor, ...]:
        *moved, harmonics = forward(self, *raw)
        return *moved, harmonics + 0.5

    monkeypatch.setattr(field, "forward", brighter)
    changed = (adapter.colors(view, splats) - before).amax(1) > 0.1
    moves = model._dynamic[:, 0] > model.dynamic_thro if name == "swift4d" else torch.ones_like(changed)
    assert torch.equal(changed, moves)
