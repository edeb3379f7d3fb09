"""LPIPS from local weight files; made-up weights stand for the published ones, which no test may download."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
import torch
from torch import nn

from d2_plugin.errors import D2Error
from d2_plugin.runs.lpips import Lpips, find_lpips

CONVOLUTIONS = {
    "alex": {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)},
    "vgg": {0: (64, 3, 3), 2: (64, 64, 3), 5: (128, 64, 3), 7: (128, 128, 3), 10: (256, 128, 3), 12: (256, 256, 3),
            14: (256, 256, 3), 17: (512, 256, 3), 19: (512, 512, 3), 21: (512, 512, 3), 24: (512, 512, 3),
            26: (512, 512, 3), 28: (512, 512, 3)},
}  # fmt: skip
"""Layer numbers and shapes (out, in, kernel) of torchvision's state dictionaries."""

CHANNELS = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}


FILES = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth"}
"""As torchvision publishes them."""


def write_weights(folder: Path, net: str = "alex") -> dict[str, torch.Tensor]:
    """Random weights of a network and its linear layers, in files named and keyed like the published ones."""
    generator = torch.Generator().manual_seed(0)
    state = {"classifier.1.weight": torch.zeros(2, 2)}  # ignored
    for number, (out, width, kernel) in CONVOLUTIONS[net].items():
        shape = (out, width, kernel, kernel)
        state[f"features.{number}.weight"] = torch.randn(shape, generator=generator) * (2 / (width * kernel**2)) ** 0.5
        state[f"features.{number}.bias"] = 0.1 * torch.randn(out, generator=generator)
    linear = {
        f"lin{i}.model.1.weight": torch.rand(1, channels, 1, 1, generator=generator)
        for i, channels in enumerate(CHANNELS[net])
    }
    torch.save(state, folder / FILES[net])
    torch.save(linear, folder / f"{net}.pth")
    return state | linear


@pytest.fixture(scope="module")
def alex(tmp_path_factory: pytest.TempPathFactory) -> tuple[Lpips, dict[str, torch.Tensor]]:
    folder = tmp_path_factory.mktemp("weights")
    weights = write_weights(folder)
    found = find_lpips("alex", folder)
    assert found is not None
    return found, weights


def test_equal_images_have_no_distance_and_the_order_does_not_matter(alex) -> None:
    a, b = torch.rand(2, 70, 80, 3, generator=torch.Generator().manual_seed(1))
    distance, _ = alex
    assert distance(a, a) == 0
    assert distance(a, b) == pytest.approx(distance(b, a))
    assert distance(a, b) > distance(a, (0.9 * a + 0.1 * b)) > 0


BLOCKS = {
    "alex": [[(0, 4, 2)], [(3, 1, 2)], [(6, 1, 1)], [(8, 1, 1)], [(10, 1, 1)]],
    "vgg": [[(n, 1, 1) for n in block] for block in ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))],
}
"""Layer, stride and padding of each convolution, by the depth at which features are compared."""
POOLED = {"alex": {1: 3, 2: 3}, "vgg": dict.fromkeys(range(1, 5), 2)}
"""Window of the pooling before a block."""


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_the_distance_is_the_published_formula_on_images_in_0_to_1(tmp_path: Path, net: str) -> None:
    weights = write_weights(tmp_path, net)
    distance = find_lpips(net, tmp_path)
    assert distance is not None
    assert net in distance.variant
    a, b = torch.rand(2, 66, 66, 3, generator=torch.Generator().manual_seed(2))
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    x = torch.stack([((image - shift) / scale).permute(2, 0, 1) for image in (a, b)])
    total = 0.0
    for i, block in enumerate(BLOCKS[net]):
        x = nn.functional.max_pool2d(x, POOLED[net][i], 2) if i in POOLED[net] else x
        for number, stride, padding in block:
            weight, bias = weights[f"features.{number}.weight"], weights[f"features.{number}.bias"]
            x = nn.functional.conv2d(x, weight, bias, stride=stride, padding=padding).relu()
        unit = x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
        total += nn.functional.conv2d((unit[:1] - unit[1:]) ** 2, weights[f"lin{i}.model.1.weight"]).mean().item()
    assert distance(a, b) == pytest.approx(total, rel=1e-5)


def test_without_weights_it_is_not_available_and_says_so_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="d2_plugin.runs.lpips"):
        assert find_lpips("alex", tmp_path) is None
    [record] = caplog.records
    assert "LPIPS is not available" in record.message
    assert "alex.pth" in record.message


def test_loading_leaves_the_global_random_state_alone(tmp_path: Path) -> None:
    write_weights(tmp_path)
    before = torch.get_rng_state()
    find_lpips("alex", tmp_path)
    assert torch.equal(torch.get_rng_state(), before)


def test_files_that_are_no_weights_are_refused(tmp_path: Path) -> None:
    write_weights(tmp_path)
    torch.save({"lin0.model.1.weight": torch.rand(1, 64, 1, 1)}, tmp_path / "alex.pth")
    with pytest.raises(D2Error, match="do not fit LPIPS alex"):
        find_lpips("alex", tmp_path)
    (tmp_path / "alex.pth").write_bytes(b"nothing")
    with pytest.raises(D2Error, match=r"cannot read LPIPS weights .*alex\.pth"):
        find_lpips("alex", tmp_path)
    with pytest.raises(D2Error, match="unknown LPIPS network 'squeeze'"):
        find_lpips("squeeze", tmp_path)


def test_images_too_small_for_the_network_are_refused(alex) -> None:
    with pytest.raises(D2Error, match="at least 64x64 pixels"):
        alex[0](torch.rand(32, 80, 3), torch.rand(32, 80, 3))
