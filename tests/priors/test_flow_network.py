"""A network of optical flow: sizes, values, and what is refused; what is made of its flow is in test_between."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tiny_onnx
from refusals import refuses

from d2_plugin.priors.flow_network import FlowNetwork
from d2_plugin.store.files import EntryFolder

pytest.importorskip("onnxruntime")
pytest.importorskip("cv2")

FIRST, SECOND = 51, 102
"""Values of two images, whose flow by the tiny network they are."""


def pair(height: int, width: int) -> list[np.ndarray]:
    return [np.full((height, width, 3), value, np.uint8) for value in (FIRST, SECOND)]


@pytest.mark.parametrize(("values", "expected"), [("bytes", (51, 102)), ("unit", (0.2, 0.4)), ("signed", (-0.6, -0.2))])
@pytest.mark.parametrize("dtype", [tiny_onnx.FLOAT, tiny_onnx.FLOAT16])
def test_flow_is_in_pixels_of_the_images(tmp_path: Path, values, expected, dtype: int) -> None:
    network = FlowNetwork(tiny_onnx.flow_network(tmp_path / "net.onnx", 60, 80, dtype), values)
    flow = network.flow(*pair(120, 320))
    assert flow.shape == (120, 320, 2)
    assert flow.dtype == np.float32
    np.testing.assert_allclose(flow, np.broadcast_to(np.multiply(expected, (4, 2)), flow.shape), rtol=2e-3, atol=1e-3)


@pytest.mark.parametrize(
    ("size", "given"),
    [((360, 640), (360, 640)), ((101, 203), (128, 256)), ((1, 16), (128, 2048)), ((509, 130), (512, 128))],
)
def test_a_network_of_free_size_gets_images_that_raft_can_halve(tmp_path: Path, size, given) -> None:
    network = FlowNetwork(tiny_onnx.flow_network(tmp_path / "net.onnx", "height", "width"))
    scale = size[1] / given[1], size[0] / given[0]
    np.testing.assert_allclose(network.flow(*pair(*size))[0, 0], np.multiply((51, 102), scale), rtol=1e-5)


def test_what_is_no_network_of_flow_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "net.onnx"
    refuses("no network of optical flow at .*: give the path of an ONNX file", FlowNetwork, path)
    tiny_onnx.mean_network(path, 60, 80)
    refuses(r"takes \[1, 3, 60, 80\]: export .* whose two inputs are \[1, 3, H, W\]", FlowNetwork, path)
    tiny_onnx.flow_network(path, 60, 80, whole=False)
    refuses(
        r"returns \(1, 2, 1, 1\) for images of 80x60: .* returns \[1, 2, 60, 80\]", FlowNetwork(path).flow, *pair(9, 9)
    )


def test_flow_is_computed_once_for_two_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    original: Callable = FlowNetwork.flow
    monkeypatch.setattr(FlowNetwork, "flow", lambda self, *images: asked.append(1) or original(self, *images))
    path, images, entries = tiny_onnx.flow_network(tmp_path / "net.onnx", 60, 80), pair(60, 80), EntryFolder(tmp_path)
    first = FlowNetwork(path).kept(entries, "cam", 3, *images)
    np.testing.assert_array_equal(FlowNetwork(path).kept(entries, "cam", 3, *images), first)
    assert len(asked) == 1
    FlowNetwork(path, "unit").kept(entries, "cam", 3, *images)
    FlowNetwork(path, "unit").kept(entries, "cam", 3, *images[::-1])
    assert len(asked) == 3
