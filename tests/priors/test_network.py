"""Monocular networks: sizes, preprocessing, what comes out, and what is refused."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny_onnx
import torch
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses

from d2_plugin.errors import MissingExtra
from d2_plugin.priors.monocular.align import align, aligned_depth
from d2_plugin.priors.monocular.network import IMAGENET_MEAN, IMAGENET_STD, MonocularModel, external_weights, upsample
from d2_plugin.priors.settings import AlignSettings
from d2_plugin.recordings.synthetic.room import synthetic_recording

pytest.importorskip("onnxruntime")
pytest.importorskip("cv2")

IMAGE = np.random.default_rng(0).integers(0, 256, (120, 160, 3)).astype(np.uint8)
SMOOTH = np.repeat(np.linspace(0, 255, 160).astype(np.uint8)[None, :, None], 120, axis=0).repeat(3, axis=2)


def test_a_network_of_fixed_size_gets_that_size_and_values_from_0_to_1(tmp_path: Path) -> None:
    model = MonocularModel(tiny_onnx.mean_network(tmp_path / "net.onnx", 60, 80), "relative")
    assert model.preprocessing == "unit"
    tensor = model.prepare(IMAGE)
    assert tensor.shape == (1, 3, 60, 80)
    assert tensor.dtype == np.float32
    expected = IMAGE.reshape(60, 2, 80, 2, 3).mean(axis=(1, 3)) / 255  # half the size is the mean of 2x2 pixels
    np.testing.assert_allclose(tensor[0].transpose(1, 2, 0), expected, atol=1e-6)
    np.testing.assert_allclose(model.predict(IMAGE), expected.mean(axis=-1), atol=1e-6)


def test_a_network_of_free_size_gets_depth_anything_v2s_lower_bound(tmp_path: Path) -> None:
    model = MonocularModel(tiny_onnx.mean_network(tmp_path / "net.onnx", "height", "width"), "relative")
    assert model.preprocessing == "depth_anything_v2"
    assert model.input_size(1014, 1352) == (518, 686)  # short side 518, both multiples of 14
    assert model.input_size(640, 362) == (910, 518)
    assert model.input_size(180, 320) == (518, 924)
    low = MonocularModel(tiny_onnx.mean_network(tmp_path / "low.onnx", 56, "width"), "relative")
    assert low.input_size(60, 80) == (56, 70)  # as high as it must be, and no wider than that makes it
    tensor = model.prepare(SMOOTH)
    assert tensor.shape == (1, 3, 518, 686)
    restored = tensor[0].transpose(1, 2, 0) * IMAGENET_STD + IMAGENET_MEAN
    assert restored.min() == pytest.approx(0, abs=0.01)
    assert restored.max() == pytest.approx(1, abs=0.01)


def test_a_fixed_size_in_patches_of_14_is_taken_for_depth_anything_v2(tmp_path: Path) -> None:
    path = tiny_onnx.mean_network(tmp_path / "net.onnx", 28, 42)
    assert MonocularModel(path, "metric").preprocessing == "depth_anything_v2"
    assert MonocularModel(path, "metric", preprocessing="unit").preprocessing == "unit"


def test_half_precision_networks_are_fed_half_precision(tmp_path: Path) -> None:
    model = MonocularModel(tiny_onnx.mean_network(tmp_path / "net.onnx", 30, 40, dtype=tiny_onnx.FLOAT16), "relative")
    assert model.prepare(IMAGE).dtype == np.float16
    assert model.predict(IMAGE).dtype == np.float32


def test_enlarging_aligns_the_corners_as_torch_does() -> None:
    small = np.random.default_rng(0).random((7, 9)).astype(np.float32)
    map_ = torch.from_numpy(small)[None, None]
    reference = torch.nn.functional.interpolate(map_, (50, 33), mode="bilinear", align_corners=True)
    np.testing.assert_allclose(upsample(small, 50, 33), reference[0, 0].numpy(), atol=1e-5)
    np.testing.assert_array_equal(upsample(small, 7, 9), small)
    np.testing.assert_array_equal(upsample(small[:1, :1], 4, 5), np.full((4, 5), small[0, 0]))
    assert (upsample(np.full((2, 3), np.inf), 4, 5) == np.inf).all()  # a sky


def test_the_fingerprint_changes_with_file_and_preprocessing(tmp_path: Path) -> None:
    path = tiny_onnx.mean_network(tmp_path / "a.onnx", 28, 42)
    other = tiny_onnx.mean_network(tmp_path / "b.onnx", 28, 56)
    prints = {
        MonocularModel(path, "relative").fingerprint(),
        MonocularModel(path, "relative", preprocessing="unit").fingerprint(),
        MonocularModel(other, "relative").fingerprint(),
    }
    assert len(prints) == 3
    assert MonocularModel(path, "relative").fingerprint() in prints


@pytest.mark.parametrize(
    ("made", "message"),
    [
        ({"channels": 4}, r"export a network whose input is \[1, 3, H, W\]"),
        ({"channels": "h", "height": "w", "width": 3}, r"takes \[1, 'h', 'w', 3\]: export a network whose"),
        ({"batch": 4}, "takes 4 images at once: export it with a batch of 1"),
        ({"height": 200_000}, "takes images of 80x200000, expected at most 8192 a side"),
        ({"outputs": 2}, r"returns \(1, 2, 60, 80\): expected one map"),
    ],
)
def test_what_is_no_monocular_network_is_refused(tmp_path: Path, made: dict, message: str) -> None:
    path = tiny_onnx.mean_network(tmp_path / "net.onnx", **({"height": 60, "width": 80} | made))
    refuses(message, lambda: MonocularModel(path, "relative").predict(IMAGE))


def test_files_that_are_no_network_and_images_that_fill_the_memory_are_refused(tmp_path: Path) -> None:
    refuses("no network of monocular depth at", MonocularModel, tmp_path / "none.onnx", "relative")
    (tmp_path / "text.onnx").write_text("this is no network")
    refuses("cannot read .* as an ONNX network", MonocularModel, tmp_path / "text.onnx", "relative")
    free = MonocularModel(tiny_onnx.mean_network(tmp_path / "free.onnx", "h", "w"), "relative")
    refuses("an image of 60000x10 would enter .* at most 8192 a side", free.input_size, 10, 60_000)


def test_a_missing_onnxruntime_is_told_with_the_command_that_mends_it(tmp_path: Path, monkeypatch) -> None:
    path = tiny_onnx.mean_network(tmp_path / "net.onnx", 60, 80)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    refuses(r"pip install 'd2-4dgs\[mono\]'", MonocularModel, path, "relative", error=MissingExtra)


def test_a_real_network_sees_the_nearer_thing_as_nearer(shared_data: Callable[[str], Path]) -> None:
    model = MonocularModel(shared_data("weights") / "mobile_pydnet.onnx", "relative")
    assert (model.input.height, model.input.width, model.preprocessing) == (192, 640, "unit")
    recording = synthetic_recording(cameras=1, frames=1, width=320, height=180)
    depth = recording.depth("train0", 0)
    mono = upsample(model.predict(recording.image("train0", 0)), 180, 320)
    alignment = align(mono, depth, kind="relative", settings=AlignSettings())
    assert alignment.accepted, alignment.status
    assert alignment.rank_correlation > 0.4
    aligned = aligned_depth(mono, alignment, 30.0)
    spread = np.median(np.abs(depth - np.median(depth)) / depth)
    assert np.median(np.abs(aligned - depth) / depth) < 0.8 * spread  # better than one depth for all


def test_a_network_that_fails_on_a_image_names_itself(tmp_path: Path) -> None:
    model = MonocularModel(tiny_onnx.mean_network(tmp_path / "net.onnx", 32, 48), "relative")
    model.input = replace(model.input, height=16)  # as a file that does not keep what it says
    refuses(r"cannot read what .*net.onnx makes of an image of 48x16", model.predict, np.zeros((32, 48, 3), np.uint8))


@pytest.mark.parametrize("place", ["weights.bin", "below/weights.bin", "w" * 150])
def test_weights_that_lie_beside_the_network_belong_to_it(tmp_path: Path, place: str) -> None:
    """Networks above 2 GB keep them so: with other weights the file is the same and the maps are not."""
    weights = tmp_path / place
    weights.parent.mkdir(exist_ok=True)
    found = {}
    for factor in (1.0, 2.0):
        weights.write_bytes(np.float32(factor).tobytes())
        path = tiny_onnx.scaled_network(tmp_path / "network.onnx", place)
        assert external_weights(path) == [weights]
        model = MonocularModel(path, "relative", preprocessing="unit")
        np.testing.assert_allclose(model.predict(np.full((6, 8, 3), 51, np.uint8)), factor * 0.2, rtol=1e-6)
        found[factor] = model.fingerprint()
    assert found[1.0] != found[2.0]


@given(st.binary(max_size=60), st.integers(0, 4))
def test_a_file_that_only_looks_like_a_network_names_no_weights(tmp_path_factory, noise: bytes, copies: int) -> None:
    path = tmp_path_factory.getbasetemp() / "noise.onnx"
    path.write_bytes(noise + copies * (b"\x0a\x08location\x12" + noise) + b"end")
    assert external_weights(path) in ([], [path])
