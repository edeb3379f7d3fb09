"""Every format read back: what a reader finds is what was trained, within what the format says it keeps."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from oracles.export_files import (
    ReadPage,
    covariances_from,
    pixels_apart,
    read_splatv,
    read_spz,
    read_still_ply,
    state_of,
)
from viewing.export.scenes import DURATION, make_scene, sharp_model

from d2_plugin.backbones.yang4d import Yang4D, Yang4DSettings
from d2_plugin.errors import D2Error
from d2_plugin.gaussians.moving import Harmonics, MovingGaussians
from d2_plugin.gaussians.slicing import slice_gaussians
from d2_plugin.gaussians.spherical_harmonics import SH_C0
from d2_plugin.viewing.checkpoints import read_ply
from d2_plugin.viewing.export.coded import encode, seen_rows
from d2_plugin.viewing.export.export import FORMATS, Export, write_export
from d2_plugin.viewing.export.keys import STILL, bake, cholesky, covariances_of, morton_order, state_at
from d2_plugin.viewing.export.page import to_json, write_page
from d2_plugin.viewing.export.ply import scales_and_rotations, write_ply
from d2_plugin.viewing.export.splatv import write_splatv
from d2_plugin.viewing.export.spz import FLIPS, write_spz

TIMES = (0.0, 0.13, 0.5)


def harmonic_scene(count: int = 300) -> MovingGaussians:
    """Still Gaussians with harmonics of degree 3."""
    still, _ = make_scene(sharp_model("yang4d", count)).still_at(0.2)
    generator = torch.Generator().manual_seed(4)
    more = 0.3 * torch.randn(len(still), 15, 3, generator=generator).double()
    coefficients = torch.cat([still.harmonics.coefficients.clamp(-3, 3), more.clamp(-0.9, 0.9)], 1)
    return MovingGaussians(still.positions, still.covariances, still.opacities, Harmonics(coefficients, 3))


def with_harmonics(count: int) -> Yang4D:
    """4D Gaussians with harmonics of degree 3."""
    plain = sharp_model("yang4d", count)
    rows = {name: value.detach() for name, value in plain.gaussians.parameters.items()}
    rows["harmonics"] = 0.2 * torch.randn(len(plain), 15, 3, generator=torch.Generator().manual_seed(3))
    return Yang4D(rows, Yang4DSettings(sh_degree=3, background=False), 2.0, DURATION)


class TestStraightLines:
    @pytest.mark.parametrize("temporal", [True, False])
    def test_they_are_the_sliced_gaussians_at_every_time(self, temporal: bool) -> None:
        model = sharp_model("yang4d", temporal=temporal)
        moving = model.moving()
        raw = {name: value.detach().double() for name, value in model._raw().items()}
        for time in TIMES:
            true, moved = slice_gaussians(raw, time), moving.at(time)
            torch.testing.assert_close(moved.rows, true.rows)
            for name in ("means", "covariances", "opacities"):
                torch.testing.assert_close(getattr(moved, name), getattr(true, name), rtol=1e-9, atol=1e-12)

    def test_a_model_whose_field_still_warms_up_stands_still(self) -> None:
        model = sharp_model("hexplane")
        assert model.moving() is None
        model.deforms = False
        assert model.moving().motion is None

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
            decoded = encode("a", values, bits, decode=True).decoded.numpy()
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
        off = np.abs(encode("p", positions[order], decode=True).decoded.numpy() - positions[order]).max(1)
        assert (off > 1e-3).sum() <= 256
        assert np.quantile(off, 0.8) < 1e-5


class TestThePage:
    def test_harmonics_are_coarser_where_the_page_must_be_small(self, tmp_path: Path) -> None:
        scene, fine, coarse = make_scene(with_harmonics(4000)), tmp_path / "fine.html", tmp_path / "coarse.html"
        assert not any("harmonics in" in line for line in write_page(scene, fine))
        most = 0.75e-6 * fine.stat().st_size
        [note] = [line for line in write_page(scene, coarse, most) if "harmonics in" in line]
        assert coarse.stat().st_size < 1e6 * most
        pages = ReadPage(fine), ReadPage(coarse)
        bits = [page.bits["harmonics"] for page in pages]
        assert bits[0] == 8 > bits[1]
        assert f"in {bits[1]} bits" in note
        off = (pages[0].coefficients - pages[1].coefficients).abs()
        assert off[:, 0].max() == 0, "the constant colour keeps its 16 bits"
        assert 0 < off.max() < 2 / (2 ** bits[1] - 1), "half a step of a block, which spans less than two"

    @pytest.mark.slow
    @pytest.mark.parametrize("backbone", ["yang4d", "hexplane", "harmonics"])
    def test_a_page_keeps_to_its_megabytes(self, tmp_path: Path, backbone: str) -> None:
        model = with_harmonics(20_000) if backbone == "harmonics" else sharp_model(backbone, 20_000)
        write_page(make_scene(model), tmp_path / "scene.html", 2.6)
        assert (tmp_path / "scene.html").stat().st_size < 2.6e6

    @pytest.mark.parametrize("backbone", ["yang4d", "hexplane"])
    def test_a_reader_finds_the_gaussians_within_a_hundredth_of_a_pixel(self, tmp_path: Path, backbone: str) -> None:
        scene = make_scene(sharp_model(backbone))
        write_page(scene, tmp_path / "scene.html")
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
        write_page(make_scene(sharp_model("yang4d")), tmp_path / "scene.html")
        text = (tmp_path / "scene.html").read_text()
        assert "http:" not in text
        assert "https:" not in text
        assert "default-src 'none'" in text
        assert text.count("</script>") == 4
        assert "<" not in to_json({"name": "</script><script>"})
        assert json.loads(to_json({"name": "</script>&"})) == {"name": "</script>&"}

    def test_a_page_of_somebody_else_is_not_replaced(self, tmp_path: Path) -> None:
        scene, path = make_scene(sharp_model("yang4d", 50)), tmp_path / "scene.html"
        path.write_text("<p>mine</p>")
        with pytest.raises(D2Error, match="was not written by `d2 export` and is kept: give another --output"):
            write_export(scene, Export(Path()), tmp_path)
        assert path.read_text() == "<p>mine</p>"
        path.unlink()
        for _ in range(2):  # its own page is replaced
            write_export(scene, Export(Path()), tmp_path)


class TestKeys:
    def test_fewer_keys_mean_a_larger_error_that_is_reported_and_at_its_keys_it_is_the_model(self) -> None:
        scene = make_scene(sharp_model("hexplane"))
        few, many = bake(scene, lambda moving, changing: 3), bake(scene, lambda moving, changing: 99)
        assert len(few.times) == 3
        assert len(many.times) == len(scene.seconds)
        assert few.offset.hundredth > 2 * many.offset.hundredth > 0
        for time in many.times:
            true = state_at(scene, time).select(many.rows)
            off = (many.at(time).positions - true.positions).norm(dim=-1) * scene.pixels_per_unit(true.positions)
            assert off.max() <= STILL + 1e-6

    def test_what_stands_still_has_no_keys(self) -> None:
        keys = bake(make_scene(sharp_model("yang4d", temporal=False)), lambda moving, changing: 99)
        assert (keys.moving, keys.changing, len(keys.times)) == (0, 0, 2)


class TestSplatv:
    @pytest.mark.parametrize("temporal", [True, False])
    def test_a_reader_finds_the_moving_gaussians(self, tmp_path: Path, temporal: bool) -> None:
        scene = make_scene(sharp_model("yang4d", temporal=temporal))
        shown = scene.moving.select(seen_rows(scene.moving, DURATION))
        write_splatv(tmp_path / "a", shown, DURATION, scene.train_cameras)
        read = read_splatv(tmp_path / "a", DURATION)
        assert len(read) == len(shown)
        assert pixels_apart(scene, shown, read).hundredth < 0.2
        for time in TIMES:
            true, found = state_of(shown, time).opacities, state_of(read, time).opacities
            assert (true - found).abs().quantile(0.99) < 0.01

    def test_a_row_stands_where_its_players_look(self, tmp_path: Path) -> None:
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

    def test_a_field_becomes_curves_whose_error_is_reported(self, tmp_path: Path) -> None:
        _, notes = write_export(make_scene(sharp_model("hexplane")), Export(Path(), "splatv"), tmp_path)
        assert "cubic curve for each Gaussian: off by median" in notes[0]


class TestStills:
    def test_ply_frames_hold_harmonics_where_viewers_look(self, tmp_path: Path) -> None:
        still, path = harmonic_scene(), tmp_path / "a.ply"
        c, kept = still.harmonics.coefficients, still.opacities >= 1 / 255
        write_ply(path, still, scales_and_rotations(still.covariances))
        green = read_ply(path)["f_rest_15"].double()  # of the first coefficient above the constant one
        torch.testing.assert_close(green, c[kept, 1, 1], rtol=1e-6, atol=0)
        read = read_still_ply(path)
        torch.testing.assert_close(read.harmonics.coefficients, c[kept], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(read.covariances, still.covariances[kept], rtol=1e-4, atol=1e-9)

    def test_spz_is_within_its_codes(self, tmp_path: Path) -> None:
        still = harmonic_scene()
        write_spz(tmp_path / "a.spz", still, scales_and_rotations(still.covariances))
        read, true = read_spz(tmp_path / "a.spz"), still.select((still.opacities >= 1 / 255).nonzero()[:, 0])
        assert (read.positions - true.positions).abs().max() <= 0.5 / 4096 + 1e-9
        opacities = true.opacities.clamp(max=254 / 255)  # full opacity has no logit
        assert (read.opacities - opacities).abs().max() <= 0.5 / 255 + 1e-9
        off = (read.harmonics.coefficients - true.harmonics.coefficients).abs()
        assert off[:, 0].max() <= 0.5 / (0.15 * 255) + 1e-9
        assert off[:, 1:4].max() <= (8 + 1) / 2 / 128 + 1e-9
        assert off[:, 4:].max() <= (16 + 1) / 2 / 128 + 1e-9
        size = true.covariances[:, [0, 3, 5]].sum(1)
        assert ((read.covariances - true.covariances).abs().amax(1) / size).max() < 0.08

    def test_niantic_s_own_library_reads_our_spz(self, tmp_path: Path) -> None:
        """@spz-loader/core is nianticlabs/spz compiled for JavaScript: `npm install @spz-loader/core`, NODE_PATH."""
        node = shutil.which("node")
        if node is None:
            pytest.skip("no Node.js here")
        still = harmonic_scene()
        write_spz(tmp_path / "a.spz", still, scales_and_rotations(still.covariances))
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
    paths, _ = write_export(scene, Export(Path(), kind, frames=(1, 5) if kind in ("ply", "spz") else None), tmp_path)
    assert all(path.stat().st_size for path in paths)
    assert len(paths) == (2 if kind in ("ply", "spz") else 1)
