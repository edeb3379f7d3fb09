"""Every format read back: what a reader finds is what was trained, within what the format says it keeps."""

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.export_files import ReadPage, covariances_from, covariances_of, read_still_ply, splats_at
from refusals import refuses
from viewing.export.scenes import DURATION, make_scene, sharp_model, with_harmonics

from d2_plugin.gaussians.moving import Harmonics, LinearMotion, MovingGaussians
from d2_plugin.gaussians.slicing import slice_gaussians
from d2_plugin.recordings import select_frames
from d2_plugin.viewing.checkpoints import read_ply
from d2_plugin.viewing.checkpoints.files import columns
from d2_plugin.viewing.export import compact
from d2_plugin.viewing.export.coded import encode, seen_rows
from d2_plugin.viewing.export.export import Export, run, write_export
from d2_plugin.viewing.export.keys import STILL, bake, cholesky, morton_order, state_at
from d2_plugin.viewing.export.page import to_json, write_page
from d2_plugin.viewing.export.ply import scales_and_rotations, write_ply
from d2_plugin.viewing.export.scene import export_scene

TIMES = (0.0, 0.13, 0.5)


class TestStraightLines:
    @pytest.mark.parametrize("temporal", [True, False])
    def test_they_are_the_sliced_gaussians_at_every_time(self, temporal: bool) -> None:
        model = sharp_model("yang4d", temporal=temporal)
        moving = model.moving()
        raw = {name: value.detach().double() for name, value in model._raw().items()}
        for time in TIMES:
            true, moved = slice_gaussians(raw, time), splats_at(moving, time)
            torch.testing.assert_close(moved.rows, true.rows)
            for name in ("means", "covariances", "opacities"):
                torch.testing.assert_close(getattr(moved, name), getattr(true, name), rtol=1e-9, atol=1e-12)

    def test_a_factor_is_the_square_root_of_its_covariance(self) -> None:
        covariances = sharp_model("yang4d").moving().covariances
        torch.testing.assert_close(covariances_of(cholesky(covariances)), covariances, rtol=1e-9, atol=1e-15)
        flat = torch.tensor([[1.0, 1, 0, 1, 0, 0], [1e-12, 0, 0, 1e-12, 0, -1e-20]])
        assert torch.isfinite(cholesky(flat)).all()


class TestCodes:
    @pytest.mark.parametrize("rows", [0, 1, 255, 256, 257, 1000])
    def test_a_code_is_within_half_a_step_of_its_block(self, rows: int) -> None:
        values = np.random.default_rng(0).normal(size=(rows, 3)) * [1, 100, 1e-6] + [0, 5, 0]
        for bits in (3, 5, 8, 16):
            decoded = encode("a", values, bits).decoded.numpy()
            assert decoded.shape == values.shape
            for start in range(0, rows, 256):
                block = values[start : start + 256]
                step = np.ptp(block, axis=0) / (2**bits - 1)
                rounded = 1.2e-7 * np.abs(block).max(0)  # the ranges are float32
                assert (np.abs(decoded[start : start + 256] - block) <= 0.5 * step + rounded).all()

    def test_an_outlier_costs_precision_in_its_own_block_only(self) -> None:
        positions = np.random.default_rng(0).random((2000, 3))
        positions[7] = 1e6
        order = morton_order(positions)
        off = np.abs(encode("p", positions[order]).decoded.numpy() - positions[order]).max(1)
        assert (off > 1e-3).sum() <= 256
        assert np.quantile(off, 0.8) < 1e-5


class TestThePage:
    def test_two_models_stand_beside_each_other_with_the_recorded_images(self, tmp_path: Path) -> None:
        scenes = [make_scene(sharp_model("yang4d", count), run) for count, run in ((100, "one"), (300, "two"))]
        scenes[1].viewed.recording.late["right"] = {1: 0.01}
        about = write_page(scenes, tmp_path / "scene.html")
        pages = [ReadPage(tmp_path / "scene.html", model) for model in (0, 1)]
        assert [page.model["name"] for page in pages] == ["one", "two"]
        assert [len(page.coefficients) for page in pages] == [page.model["count"] for page in pages]
        assert pages[0].model["count"] < 110 < pages[1].model["count"]
        kept = pages[0].header["recorded"]["right"]  # the held-out camera
        assert [when for when, _, _ in kept] == [0, scenes[1].seconds[1] + 0.01, *scenes[1].seconds[2:]]
        cv2 = pytest.importorskip("cv2", reason="opencv is in the `image` extra")
        _, at, length = kept[0]
        image = cv2.imdecode(np.frombuffer(pages[0].raw[at : at + length], np.uint8), cv2.IMREAD_COLOR)
        assert np.abs(image.astype(int) - 60).max() <= 2, "what the recording holds there"
        assert any("12 recorded images of the cameras right" in line for line in about)

    def test_of_every_second_frame_the_page_says_their_rate(self, tmp_path: Path) -> None:
        scene = make_scene(sharp_model("yang4d", 50))
        whole = scene.viewed.recording
        viewed = replace(scene.viewed, recording=select_frames(whole, whole.frames[::2]))
        about = write_page([export_scene(viewed)], tmp_path / "scene.html")
        assert f"{len(whole.frames) // 2} frames at {whole.fps / 2:g} per second" in about

    def test_runs_of_two_recordings_are_not_compared(self, tmp_path: Path) -> None:
        scenes = [make_scene(sharp_model("yang4d", 50), "a", names) for names in (("l", "m", "r"), ("l", "m", "s"))]
        refuses("not the same cameras and frames: compare runs of one", write_page, scenes, tmp_path / "scene.html")

    @pytest.mark.parametrize("backbone", ["yang4d", "deform"])
    def test_a_reader_finds_the_gaussians_within_a_hundredth_of_a_pixel(self, tmp_path: Path, backbone: str) -> None:
        scene = make_scene(sharp_model(backbone))
        write_page([scene], tmp_path / "scene.html")
        read = ReadPage(tmp_path / "scene.html")
        true = [state_at(scene, time) for time in scene.seconds[::4]]
        visible = torch.stack([state.opacities for state in true]).amax(0) >= 1 / 255
        for time, state in zip(scene.seconds[::4], true):
            drawn = state.select((state.opacities >= 1 / 255).nonzero()[:, 0]).positions
            page = read.at(time)
            nearest = torch.cdist(drawn, page.positions[page.opacities >= 1 / 255]).amin(1)
            assert (nearest * scene.pixels_per_unit(drawn)).max() < 0.01
        assert len(read.coefficients) <= int(visible.sum()) + 5

    def test_it_names_no_address_of_the_network_and_no_name_can_close_a_script(self, tmp_path: Path) -> None:
        write_page([make_scene(sharp_model("yang4d"))], tmp_path / "scene.html")
        text = (tmp_path / "scene.html").read_text()
        assert "http:" not in text
        assert "https:" not in text
        assert "default-src 'none'" in text
        assert text.count("</script>") == 5
        assert "<" not in to_json({"name": "</script><script>"})
        assert json.loads(to_json({"name": "</script>&"})) == {"name": "</script>&"}

    def test_a_page_of_somebody_else_is_not_replaced(self, tmp_path: Path) -> None:
        scene, path = make_scene(sharp_model("yang4d", 50)), tmp_path / "scene.html"
        path.write_text("<p>mine</p>")
        says = "was not written by `d2 export` and is kept: choose another place"
        refuses(says, write_export, [scene], Export((Path(),)), tmp_path)
        assert path.read_text() == "<p>mine</p>"
        path.unlink()
        for _ in range(2):  # its own page is replaced
            write_export([scene], Export((Path(),)), tmp_path)


class TestKeys:
    def test_at_its_keys_it_is_the_model_and_between_them_as_far_off_as_it_says(self, monkeypatch) -> None:
        scene = make_scene(sharp_model("deform"))
        many = bake(scene)
        monkeypatch.setattr("d2_plugin.viewing.export.keys.GOOD", 1e3)
        few = bake(scene)
        assert len(few.times) == 2
        assert few.offset.hundredth > 2 * many.offset.hundredth
        for time in many.times:
            true = state_at(scene, time).select(many.rows)
            off = (many.at(time).positions - true.positions).norm(dim=-1) * scene.pixels_per_unit(true.positions)
            assert off.max() <= STILL + 1e-6

    def test_what_stands_still_has_no_keys(self) -> None:
        keys = bake(make_scene(sharp_model("yang4d", temporal=False)))
        assert (keys.moving, keys.changing, len(keys.times)) == (0, 0, 2)


class TestOthersReadIt:
    """Each format read back by a program of somebody else."""

    @pytest.mark.parametrize("temporal", [True, False])
    def test_fourdgs_reads_the_moving_gaussians(self, tmp_path: Path, temporal: bool) -> None:
        fourdgs = pytest.importorskip("fourdgs", reason="fourdgs is in the `formats` extra")
        scene = make_scene(with_harmonics(300) if temporal else sharp_model("yang4d", temporal=False))
        [path], notes = write_export([scene], Export((Path(),), "4dgs"), tmp_path)
        assert "checks the file against its own error bounds" in notes[0]
        read = fourdgs.read(str(path)).gaussians
        names = ("positions", "scales", "rotations", "colors", "motions", "mu_t", "sigma_t")
        positions, scales, rotations, colors, *motion = (
            torch.from_numpy(np.asarray(getattr(read, name), np.float64)) for name in names
        )
        shape, harmonics = covariances_from(scales, rotations[:, [3, 0, 1, 2]]), Harmonics(colors[:, None, :3], 0)
        found = MovingGaussians(positions, shape, colors[:, 3], harmonics, LinearMotion(*motion))
        shown = scene.moving.select(seen_rows(scene.moving, DURATION))
        assert len(found) == len(shown)
        for time in TIMES:  # in another order: by their places
            here, there = splats_at(shown, time), splats_at(found, time)
            apart = torch.cdist(here.means, there.means)
            seen = (here.opacities >= 1 / 255) & (scene.pixels_per_unit(here.means) > 0)
            nearest = apart.argmin(1)
            pixels = apart.amin(1) * scene.pixels_per_unit(here.means)
            assert pixels[seen].quantile(0.99) < 0.2
            assert (here.opacities - there.opacities[nearest])[seen].abs().quantile(0.95) < 0.02
        assert read.sh_degree == shown.harmonics.degree

    def test_a_deformation_field_has_no_place_in_it(self, tmp_path: Path) -> None:
        pytest.importorskip("fourdgs", reason="fourdgs is in the `formats` extra")
        scenes, says = [make_scene(sharp_model("deform"))], "this model moves by a network: choose --format html or ply"
        refuses(says, write_export, scenes, Export((Path(),), "4dgs"), tmp_path)

    @pytest.mark.parametrize("kind", ["sog", "spz", "glb"])
    def test_others_read_what_splat_transform_writes(self, tmp_path: Path, kind: str) -> None:
        """All that is seen is there, up to a turn of the axes by half a circle."""
        if shutil.which("splat-transform") is None:
            pytest.skip("splat-transform is not on the PATH: npm install -g @playcanvas/splat-transform")
        scene = make_scene(sharp_model("yang4d"))
        [path, _], _ = write_export([scene], Export((Path(),), kind, frames=(1, 5)), tmp_path)
        if kind == "glb":
            fourdgs = pytest.importorskip("fourdgs", reason="fourdgs is in the `formats` extra")
            found = fourdgs.from_gltf(str(path)).gaussians
            parts = (torch.from_numpy(np.asarray(part, np.float64)) for part in (found.positions, found.colors[:, 3]))
            positions, opacities = parts
        else:
            subprocess.run(["splat-transform", "-q", "-w", str(path), str(tmp_path / "back.ply")], check=True)
            read = read_still_ply(tmp_path / "back.ply")
            positions, opacities = read.positions, read.opacities
        true = scene.still_at(scene.seconds[1])[0]
        kept = (true.opacities >= 1 / 255).nonzero()[:, 0]
        places = true.positions[kept]
        assert len(positions) == len(kept)
        turns = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, -1, 1]]).double()
        apart = min((torch.cdist(places, positions * axes) for axes in turns), key=lambda d: d.amin(1).sum())
        assert (apart.amin(1) * scene.pixels_per_unit(places)).quantile(0.95) < 0.5
        assert (true.opacities[kept] - opacities[apart.argmin(1)]).abs().quantile(0.9) < 0.01

    def test_without_the_converter_one_sentence_says_how_to_get_it(self, tmp_path: Path, monkeypatch) -> None:
        monkeypatch.setenv("PATH", str(tmp_path))
        refuses("npm install -g @playcanvas/splat-transform", run, Export((tmp_path / "none",), "sog"))


class TestFewer:
    """`d2 export --keep`: what goes is what images would miss least."""

    def test_a_checkpoint_of_another_trainer_is_refused(self) -> None:
        viewed = make_scene(sharp_model("yang4d")).viewed
        del viewed.backbone.model
        refuses("tiny is no run of `d2 train`: leave out --keep", compact.compacted, viewed, 0.5)


def random_gaussians(count: int, seed: int = 0, spread: float = 3.0, degree: int = 0) -> tuple[torch.Tensor, ...]:
    """Random means, covariances, coefficients of harmonics and opacities."""
    generator = torch.Generator().manual_seed(seed)
    factors = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))[0]
    scales = torch.exp(spread * (torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5))
    matrices = factors @ torch.diag_embed(scales**2) @ factors.mT
    packed = matrices[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    means, coefficients = (torch.randn(count, n, 3, generator=generator) for n in (1, (degree + 1) ** 2))
    return means[:, 0], packed, coefficients, torch.rand(count, generator=generator)


def write_still(path: Path, *parts: torch.Tensor) -> None:
    """A file of means, covariances, coefficients of harmonics and opacities."""
    means, covariances, coefficients, opacities = (part.double() for part in parts)
    harmonics = Harmonics(coefficients, round(coefficients.shape[1] ** 0.5) - 1)
    write_ply(path, MovingGaussians(means, covariances, opacities, harmonics), scales_and_rotations(covariances))


def off(rebuilt: torch.Tensor, true: torch.Tensor) -> float:
    """The largest difference of covariances [M, 6] in sizes of theirs."""
    return float(((rebuilt - true).abs() / true.abs().amax(1, keepdim=True)).max())


@pytest.mark.parametrize("degree", [0, 3])
def test_a_viewer_reads_back_the_gaussians(tmp_path: Path, degree: int) -> None:
    """After the constant harmonic all coefficients of red, then of green, then of blue."""
    means, covariances, coefficients, opacities = random_gaussians(50, degree=degree)
    opacities = 0.02 + 0.9 * opacities
    path = tmp_path / "frame_00000.ply"
    write_still(path, means, covariances, coefficients, opacities)
    header = path.read_bytes().partition(b"end_header\n")[0].decode("ascii").splitlines()
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "element vertex 50" in header
    rest = " ".join(f"f_rest_{i}" for i in range(3 * (degree + 1) ** 2 - 3))
    order = f"x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 {rest} opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert [line for line in header if "property" in line] == [f"property float {name}" for name in order.split()]
    torch.testing.assert_close(columns(read_ply(path), "rot").norm(dim=1), torch.ones(50))
    read = read_still_ply(path)
    assert torch.equal(read.positions, means.double())
    assert torch.equal(read.harmonics.coefficients, coefficients.double())
    torch.testing.assert_close(read.opacities, opacities.double(), atol=1e-6, rtol=0)
    assert off(read.covariances, covariances) < 2e-6


def test_what_no_rasterizer_draws_is_left_out(tmp_path: Path) -> None:
    means, covariances, coefficients, _ = random_gaussians(6)
    opacities = torch.tensor([0.5, 1 / 254, 1 / 256, 0.0, 1.0, 0.5])
    means[5, 1] = torch.nan
    write_still(tmp_path / "a.ply", means, covariances, coefficients, opacities)
    rows = read_ply(tmp_path / "a.ply")
    assert torch.equal(rows["x"], means[[0, 1, 4], 0])
    assert all(torch.isfinite(column).all() for column in rows.values()), "an opacity of 1 too has a logit"
    write_still(tmp_path / "a.ply", means, covariances, coefficients, 0 * opacities)
    assert b"element vertex 0\n" in (tmp_path / "a.ply").read_bytes()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.floats(0, 12))
def test_rotations_rebuild_the_covariance(seed: int, spread: float) -> None:
    _, covariances, *_ = random_gaussians(8, seed, spread)
    assert off(covariances_from(*scales_and_rotations(covariances)), covariances) < 1e-10


def test_flat_and_round_gaussians_have_finite_scales() -> None:
    flat = torch.tensor([[1.0, 0, 0, 1.0, 0, 0], [1.0, 0, 0, 1.0, 0, 1.0], [1e-30, 0, 0, 1e-30, 0, 1e-30]]).double()
    flat[0, 5] = -1e-8  # rounding of a float32 covariance
    scales, quaternions = scales_and_rotations(flat)
    assert torch.isfinite(scales.log()).all()
    assert torch.isfinite(quaternions).all()
    torch.testing.assert_close(scales[1], torch.ones(3, dtype=torch.float64))
