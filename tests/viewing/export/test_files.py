"""Every format read back: what a reader finds is what was trained, within what the format says it keeps."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from viewing.export.scenes import DURATION, make_scene, sharp_model

from d2_plugin.backbones.yang4d import Yang4D, Yang4DSettings
from d2_plugin.errors import D2Error
from d2_plugin.gaussians.moving import Harmonics, MovingGaussians
from d2_plugin.gaussians.slicing import slice_gaussians
from d2_plugin.runs.gaussian_ply import SH_C0, write_ply
from d2_plugin.viewing.export.coded_scene import seen_rows
from d2_plugin.viewing.export.codes import decode, encode, morton_order, packed, to_json, unpacked
from d2_plugin.viewing.export.export import FORMATS, Export, export_scene
from d2_plugin.viewing.export.keys import STILL, bake, cholesky, covariances_of, state_at
from d2_plugin.viewing.export.linear_files import read_ftgs, read_splatv, write_ftgs, write_splatv
from d2_plugin.viewing.export.page import read_page, write_page
from d2_plugin.viewing.export.ply_files import covariances_from, read_columns, still_gaussians
from d2_plugin.viewing.export.rounding import rounding, states_of
from d2_plugin.viewing.export.spz import FLIPS, read_spz, write_spz

TIMES = (0.0, 0.13, 0.5)


def harmonic_scene(count: int = 300) -> MovingGaussians:
    """Still Gaussians with harmonics of degree 3."""
    still = make_scene(sharp_model("yang4d", count)).still_at(0.2)
    generator = torch.Generator().manual_seed(4)
    more = 0.3 * torch.randn(len(still), 15, 3, generator=generator).double()
    coefficients = torch.cat([still.harmonics.coefficients.clamp(-3, 3), more.clamp(-0.9, 0.9)], 1)
    return MovingGaussians(still.positions, still.covariances, still.opacities, Harmonics(coefficients, 3))


class TestTheMapping:
    @pytest.mark.parametrize("temporal", [True, False])
    def test_straight_lines_are_the_sliced_gaussians_at_every_time(self, temporal: bool) -> None:
        model = sharp_model("yang4d", temporal=temporal)
        moving = model.moving()
        raw = {name: value.detach().double() for name, value in model._raw().items()}
        for time in TIMES:
            true, told = slice_gaussians(raw, time), moving.at(time)
            torch.testing.assert_close(told.rows, true.rows)
            for name in ("means", "covariances", "opacities"):
                torch.testing.assert_close(getattr(told, name), getattr(true, name), rtol=1e-9, atol=1e-12)

    def test_a_model_whose_field_still_warms_up_stands_still(self) -> None:
        model = sharp_model("hexplane")
        assert model.moving() is None
        model.deforms = False
        still = model.moving()
        assert still is not None
        assert still.motion is None

    def test_a_factor_is_the_square_root_of_its_covariance(self) -> None:
        covariances = sharp_model("yang4d").moving().covariances
        torch.testing.assert_close(covariances_of(cholesky(covariances)), covariances, rtol=1e-9, atol=1e-15)
        flat = torch.tensor([[1.0, 1, 0, 1, 0, 0], [1e-12, 0, 0, 1e-12, 0, -1e-20]])
        assert torch.isfinite(cholesky(flat)).all()


class TestCodes:
    def test_a_code_is_within_half_a_step_of_its_block(self) -> None:
        rng = np.random.default_rng(0)
        values = rng.normal(size=(1000, 3)) * [1, 100, 1e-6] + [0, 5, 0]
        for bits in (3, 5, 8, 16):
            found = decode(encode("a", values, bits))
            for start in range(0, 1000, 256):
                block = values[start : start + 256]
                step = np.ptp(block, axis=0) / (2**bits - 1)
                rounded = 1.2e-7 * np.abs(block).max(0)  # the ranges are float32
                assert (np.abs(found[start : start + 256] - block) <= 0.5 * step + rounded).all()

    @pytest.mark.parametrize("rows", [0, 1, 255, 256, 257])
    def test_any_number_of_rows_comes_back_under_its_name(self, rows: int) -> None:
        values = np.arange(rows * 2, dtype=float).reshape(rows, 2)
        found = unpacked(*packed([encode("a", values), encode("b", values[:, :1], 8)]))
        np.testing.assert_allclose(found["a"], values, atol=2e-2)
        assert found["b"].shape == (rows, 1)

    def test_an_outlier_costs_precision_in_its_own_block_only(self) -> None:
        positions = np.random.default_rng(0).random((2000, 3))
        positions[7] = 1e6
        order = morton_order(positions)
        off = np.abs(decode(encode("p", positions[order])) - positions[order]).max(1)
        assert (off > 1e-3).sum() <= 256
        assert np.quantile(off, 0.8) < 1e-5

    def test_json_in_a_page_holds_no_angle_bracket(self) -> None:
        assert "<" not in to_json({"name": "</script><script>"})
        assert json.loads(to_json({"name": "</script>&"})) == {"name": "</script>&"}


class TestThePage:
    def test_harmonics_are_coarser_where_the_page_must_be_small(self, tmp_path: Path) -> None:
        plain = sharp_model("yang4d", 4000)
        rows = {name: value.detach() for name, value in plain.gaussians.parameters.items()}
        rows["harmonics"] = 0.2 * torch.randn(len(plain), 15, 3, generator=torch.Generator().manual_seed(3))
        scene = make_scene(Yang4D(rows, Yang4DSettings(sh_degree=3, background=False), 2.0, DURATION))
        fine, coarse = tmp_path / "fine.html", tmp_path / "coarse.html"
        assert not any("harmonics in" in line for line in write_page(scene, fine).about)
        most = 0.75e-6 * fine.stat().st_size
        [said] = [line for line in write_page(scene, coarse, most).about if "harmonics in" in line]
        assert coarse.stat().st_size < 1e6 * most
        pages = read_page(fine), read_page(coarse)
        bits = [{entry["name"]: entry["bits"] for entry in page.header["arrays"]}["harmonics"] for page in pages]
        assert bits[0] == 8 > bits[1]
        assert f"in {bits[1]} bits" in said
        off = (pages[0].coefficients - pages[1].coefficients).abs()
        assert off[:, 0].max() == 0, "the constant colour keeps its 16 bits"
        assert 0 < off.max() < 2 / (2 ** bits[1] - 1), "half a step of a block, which spans less than two"

    @pytest.mark.parametrize("backbone", ["yang4d", "hexplane"])
    def test_our_reader_finds_the_gaussians_within_a_hundredth_of_a_pixel(self, tmp_path: Path, backbone: str) -> None:
        model = sharp_model(backbone)
        scene = make_scene(model)
        page = write_page(scene, tmp_path / "scene.html")
        read = read_page(tmp_path / "scene.html")
        count = len(scene.harmonics.coefficients)
        times = scene.clip.seconds[::4]
        true = [state_at(scene.splats_at, count, time) for time in times]
        visible = torch.stack([state.opacities for state in true]).amax(0) >= 1 / 255
        for time, state in zip(times, true):
            drawn = state.select((state.opacities >= 1 / 255).nonzero()[:, 0]).positions
            told = read.at(time)
            found = told.positions[told.opacities >= 1 / 255]
            nearest = torch.cdist(drawn, found).amin(1) * scene.pixels_per_unit(drawn)
            assert nearest.max() < 0.01
        assert len(read.coefficients) <= int(visible.sum()) + 5
        assert page.size == (tmp_path / "scene.html").stat().st_size
        assert "off by median" in page.about[1]

    def test_a_page_of_another_version_and_no_page_are_refused(self, tmp_path: Path) -> None:
        write_page(make_scene(sharp_model("yang4d")), tmp_path / "scene.html")
        text = (tmp_path / "scene.html").read_text()
        (tmp_path / "old.html").write_text(text.replace('"version":1', '"version":9'))
        with pytest.raises(D2Error, match="page of version 9, and this d2-4dgs reads 1"):
            read_page(tmp_path / "old.html")
        (tmp_path / "other.html").write_text("<p>hello</p>")
        with pytest.raises(D2Error, match="holds no scene"):
            read_page(tmp_path / "other.html")

    def test_the_page_names_no_address_of_the_network(self, tmp_path: Path) -> None:
        write_page(make_scene(sharp_model("yang4d")), tmp_path / "scene.html")
        text = (tmp_path / "scene.html").read_text()
        assert "http:" not in text
        assert "https:" not in text
        assert "default-src 'none'" in text
        assert text.count("</script>") == 4


class TestKeys:
    def test_a_megabyte_less_means_fewer_keys_and_a_larger_error_that_is_told(self) -> None:
        scene = make_scene(sharp_model("hexplane"))
        count = len(scene.harmonics.coefficients)
        parts = (scene.splats_at, count, scene.clip.seconds, scene.pixels_per_unit)
        few, many = bake(*parts, lambda moving, changing: 3), bake(*parts, lambda moving, changing: 99)
        assert len(few.times) == 3
        assert len(many.times) == len(scene.clip.seconds)
        assert few.offset.hundredth > 2 * many.offset.hundredth > 0

    def test_at_its_keys_it_is_the_model(self) -> None:
        scene = make_scene(sharp_model("hexplane"))
        count = len(scene.harmonics.coefficients)
        keys = bake(scene.splats_at, count, scene.clip.seconds, scene.pixels_per_unit, lambda moving, changing: 99)
        for time in keys.times:
            true = state_at(scene.splats_at, count, time).select(keys.rows)
            off = (keys.at(time).positions - true.positions).norm(dim=-1) * scene.pixels_per_unit(true.positions)
            assert off.max() <= STILL + 1e-6

    def test_what_stands_still_has_no_keys(self) -> None:
        scene = make_scene(sharp_model("yang4d", temporal=False))
        count = len(scene.harmonics.coefficients)
        keys = bake(scene.splats_at, count, scene.clip.seconds, scene.pixels_per_unit, lambda moving, changing: 99)
        assert (keys.moving, keys.changing, len(keys.times)) == (0, 0, 2)


class TestLines:
    """`.splatv` and `.ftgs.ply`: centre, width and velocity in clips."""

    @pytest.mark.parametrize("temporal", [True, False])
    @pytest.mark.parametrize(("kind", "pixels"), [("splatv", 0.2), ("ftgs", 1e-3)])
    def test_our_reader_finds_the_moving_gaussians(
        self, tmp_path: Path, kind: str, pixels: float, temporal: bool
    ) -> None:
        scene = make_scene(sharp_model("yang4d", temporal=temporal))
        shown = scene.moving.select(seen_rows(scene.moving, DURATION))
        if kind == "splatv":
            write_splatv(tmp_path / "a", shown, DURATION, scene.train_cameras)
            read = read_splatv(tmp_path / "a", DURATION)
        else:
            write_ftgs(tmp_path / "a", shown, DURATION, 12)
            read = read_ftgs(tmp_path / "a", DURATION)
        assert len(read) == len(shown)
        assert rounding(scene, states_of(shown), states_of(read)).hundredth < pixels
        for time in TIMES:
            true, told = states_of(shown)(time).opacities, states_of(read)(time).opacities
            assert (true - told).abs().quantile(0.99) < (0.01 if kind == "splatv" else 1e-5)

    def test_a_row_of_splatv_stands_where_its_players_look(self, tmp_path: Path) -> None:
        scene = make_scene(sharp_model("yang4d"))
        shown = scene.moving.select(seen_rows(scene.moving, DURATION)[:3])
        write_splatv(tmp_path / "a.splatv", shown, DURATION, scene.train_cameras)
        data = (tmp_path / "a.splatv").read_bytes()
        magic, length = np.frombuffer(data[:8], "<u4")
        assert magic == 0x674B
        body = data[8 + length :]
        assert len(body) == 4096 * 16  # one row of 4096 texels
        floats, halves = np.frombuffer(body, "<f4").reshape(-1, 16), np.frombuffer(body, "<f2").reshape(-1, 32)
        np.testing.assert_array_equal(floats[:3, :3], shown.positions.float().numpy())
        velocities, times, sigmas = shown.motion
        np.testing.assert_allclose(halves[:3, 16:19], (velocities * DURATION).numpy(), rtol=1e-3)
        assert (halves[:3, 19:30] == 0).all()
        np.testing.assert_allclose(halves[:3, 30], (times / DURATION).numpy(), rtol=1e-3)
        np.testing.assert_allclose(halves[:3, 31], (2**0.5 * sigmas / DURATION).numpy(), rtol=1e-3)

    def test_ftgs_widens_nothing_and_keeps_nothing_visible(self, tmp_path: Path) -> None:
        scene = make_scene(sharp_model("yang4d"))
        write_ftgs(tmp_path / "a.ply", scene.moving, DURATION, 12)
        header = (tmp_path / "a.ply").read_bytes().split(b"end_header")[0].decode()
        least = float(header.split("min_duration ")[1].split()[0])
        assert 0 < least <= float((scene.moving.motion.sigmas / DURATION).min()) * (1 + 1e-6)
        assert "comment opacity_floor 0\n" in header
        assert "comment ftgs_version 1\n" in header

    def test_a_field_becomes_curves_whose_error_is_told(self, tmp_path: Path) -> None:
        scene = make_scene(sharp_model("hexplane"))
        made = export_scene(scene, Export(Path(), "splatv"), tmp_path)
        assert "cubic curve for each Gaussian: off by median" in made.notes[0]
        with pytest.raises(D2Error, match="straight lines only.*take --format html or splatv"):
            export_scene(scene, Export(Path(), "ftgs"), tmp_path)


class TestStills:
    def test_ply_frames_hold_harmonics_where_viewers_look(self, tmp_path: Path) -> None:
        still = harmonic_scene()
        c = still.harmonics.coefficients
        write_ply(
            tmp_path / "a.ply", still.positions, still.covariances, SH_C0 * c[:, 0] + 0.5, still.opacities, c[:, 1:]
        )
        columns = read_columns(tmp_path / "a.ply")
        kept = still.opacities >= 1 / 255
        np.testing.assert_allclose(columns["f_rest_15"], c[kept, 1, 1].numpy(), rtol=1e-6)  # green of the first
        read = still_gaussians(columns)
        torch.testing.assert_close(read.harmonics.coefficients, c[kept], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(read.covariances, still.covariances[kept], rtol=1e-4, atol=1e-9)

    def test_spz_is_within_its_codes(self, tmp_path: Path) -> None:
        still = harmonic_scene()
        assert write_spz(tmp_path / "a.spz", still) == int((still.opacities >= 1 / 255).sum())
        read, true = read_spz(tmp_path / "a.spz"), still.select((still.opacities >= 1 / 255).nonzero()[:, 0])
        assert (read.positions - true.positions).abs().max() <= 0.5 / 4096 + 1e-9
        assert (read.opacities - true.opacities).abs().max() <= 0.5 / 255 + 1e-9
        off = (read.harmonics.coefficients - true.harmonics.coefficients).abs()
        assert off[:, 0].max() <= 0.5 / (0.15 * 255) + 1e-9
        assert off[:, 1:4].max() <= (8 + 1) / 2 / 128 + 1e-9
        assert off[:, 4:].max() <= (16 + 1) / 2 / 128 + 1e-9
        size = true.covariances[:, [0, 3, 5]].sum(1)
        assert ((read.covariances - true.covariances).abs().amax(1) / size).max() < 0.08

    def test_files_of_another_kind_are_refused(self, tmp_path: Path) -> None:
        (tmp_path / "a").write_bytes(b"hello, this is nothing of the kind")
        for read in (read_spz, read_columns, lambda path: read_splatv(path, 1.0)):
            with pytest.raises(D2Error):
                read(tmp_path / "a")

    def test_niantic_s_own_library_reads_our_spz(self, tmp_path: Path) -> None:
        """@spz-loader/core is nianticlabs/spz compiled for JavaScript: `npm install @spz-loader/core`, NODE_PATH."""
        node = shutil.which("node")
        if node is None:
            pytest.skip("no Node.js here")
        write_spz(tmp_path / "a.spz", harmonic_scene())
        script = (  # it is built for browsers, and Node must look like one
            "process.type = 'renderer'; globalThis.window = globalThis;"
            "const module = require.resolve('@spz-loader/core').replace('index.umd.cjs', 'index.js');"
            f"import(module).then(({{ loadSpz }}) => loadSpz(require('fs').readFileSync({str(tmp_path / 'a.spz')!r})))"
            ".then((s) => console.log(JSON.stringify([s.numPoints, s.shDegree, "
            "...['positions', 'scales', 'rotations', 'alphas', 'colors', 'sh'].map((name) => Array.from(s[name]))])))"
        )
        done = subprocess.run([node, "-e", script], capture_output=True, text=True, check=False)
        if "Cannot find module" in done.stderr:
            pytest.skip("the npm package @spz-loader/core is not installed where Node looks (NODE_PATH)")
        assert done.returncode == 0, done.stderr[-500:]
        count, degree, *columns = json.loads(done.stdout.splitlines()[-1])
        ours = read_spz(tmp_path / "a.spz")
        assert (count, degree) == (len(ours), 3)
        positions, scales, rotations, alphas, colors, harmonics = (np.array(c).reshape(count, -1) for c in columns)
        np.testing.assert_allclose(positions * (1, -1, -1), ours.positions.numpy(), atol=1e-5)
        np.testing.assert_allclose(alphas[:, 0], ours.opacities.numpy(), atol=1e-4)
        np.testing.assert_allclose(colors, (0.5 + SH_C0 * ours.harmonics.coefficients[:, 0]).numpy(), atol=1e-3)
        theirs = (harmonics.reshape(count, 15, 3) * FLIPS[:, None]).astype(float)
        np.testing.assert_allclose(theirs, ours.harmonics.coefficients[:, 1:].numpy(), atol=1e-4)
        wxyz = torch.from_numpy((rotations * (1, -1, -1, 1))[:, [3, 0, 1, 2]].astype(float))
        covariances = covariances_from(torch.from_numpy(scales.astype(float)), wxyz)
        torch.testing.assert_close(covariances, ours.covariances, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("kind", list(FORMATS))
def test_every_format_says_what_it_wrote(tmp_path: Path, kind: str) -> None:
    scene = make_scene(sharp_model("yang4d", 100))
    made = export_scene(scene, Export(Path(), kind, frames=(1, 5) if kind in ("ply", "spz") else None), tmp_path)
    assert made.size == sum(path.stat().st_size for path in made.paths) > 0
    assert len(made.paths) == (2 if kind in ("ply", "spz") else 1)
