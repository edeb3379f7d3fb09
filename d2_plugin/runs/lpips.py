"""LPIPS, version 0.1, computed from weight files that lie on this machine; nothing is ever downloaded.

Two files are needed per network: the feature extractor as torchvision publishes it (`alexnet-*.pth`, `vgg16-*.pth`) and
the linear layers as the `lpips` package ships them (`alex.pth`, `vgg.pth`). They are looked for in a folder that the
caller names, in torch's own download cache, and inside an installed `lpips` package.

Convention: that of lpipsPyTorch, which 3DGS codebases report. Images go in as 0..1 and are shifted and scaled by
constants made for -1..1; the `lpips` package maps to -1..1 first and gives other numbers.
"""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor, nn

from d2_plugin.errors import D2Error, refuse_unknown
from d2_plugin.reading import opened, parsing

log = logging.getLogger(__name__)

SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)

SMALLEST = 64
"""Least width and height in pixels: below it the deepest features are of two pixels each way, or of none."""

_VGG16 = ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))
"""Width and number of the convolutions of each block; blocks are pooled in between."""
_TAPS = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}  # layers (ReLUs) whose output is compared
_FILES = {"alex": ("alexnet*.pth", "alex.pth"), "vgg": ("vgg16-*.pth", "vgg.pth")}


class Lpips:
    """Learned perceptual distance of two images; `net` is `alex` or `vgg`."""

    def __init__(self, net: str, features: Path, linear: Path) -> None:
        refuse_unknown("LPIPS network", [net], _TAPS)
        self.net = net
        with torch.device("meta"):  # no random initial weights, which would advance the global random state
            self.layers = _alexnet() if net == "alex" else _vgg16()
        trained, weights, prefix = _load(features), _load(linear), "features."
        with parsing(f"{features} and {linear} as LPIPS {net}", "check the files"):
            convolutions = {k[len(prefix) :]: v for k, v in trained.items() if k.startswith(prefix)}
            self.layers.load_state_dict(convolutions, assign=True)
            self.weights = [weights[f"lin{i}.model.1.weight"].flatten() for i in range(len(_TAPS[net]))]
        self.layers.eval().requires_grad_(False)

    @torch.no_grad()
    def __call__(self, image: Tensor, truth: Tensor) -> float:
        """Distance of two images [H, W, 3] in 0..1; 0 for equal ones, larger is worse."""
        if image.shape != truth.shape or min(image.shape[:2]) < SMALLEST:
            raise D2Error(
                f"LPIPS needs two images of one size, at least {SMALLEST}x{SMALLEST} pixels, and got "
                f"{tuple(image.shape)} and {tuple(truth.shape)}: compare larger images"
            )
        pairs = zip(self._features(image), self._features(truth), self.weights)
        return sum(((a - b).square() * w[:, None, None]).sum(0).mean().item() for a, b, w in pairs)

    def _features(self, image: Tensor) -> Iterator[Tensor]:
        values = ((image.float().cpu() - torch.tensor(SHIFT)) / torch.tensor(SCALE)).permute(2, 0, 1)[None]
        for number, layer in enumerate(self.layers):
            values = layer(values)
            if number in _TAPS[self.net]:
                yield values[0] / (values[0].square().sum(0).sqrt() + 1e-10)


def find_lpips(net: str, folder: Path | None = None) -> Lpips | None:
    """LPIPS from weight files in `folder` or the usual places, or None (logged once) where there are none."""
    refuse_unknown("LPIPS network", [net], _FILES)
    package = importlib.util.find_spec("lpips")
    places = [folder] if folder is not None else [Path(torch.hub.get_dir()) / "checkpoints"]
    if folder is None and package is not None and package.origin:
        places.append(Path(package.origin).parent / "weights" / "v0.1")
    features, linear = (
        next((file for place in places for file in sorted(place.glob(name))), None) for name in _FILES[net]
    )
    if features is None or linear is None:
        log.info("LPIPS is not available: no %s and %s in %s", *_FILES[net], ", ".join(map(str, places)))
        return None
    return Lpips(net, features, linear)


def _load(path: Path) -> dict[str, Tensor]:
    with opened(path, "replace the file") as file, parsing(f"LPIPS weights {path}", "replace the file"):
        return torch.load(file, map_location="cpu", weights_only=True)


def _alexnet() -> nn.Sequential:
    """The convolutions of AlexNet, numbered as torchvision does."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(),
    )  # fmt: skip


def _vgg16() -> nn.Sequential:
    """The convolutions of VGG16 up to relu5_3, numbered as torchvision does."""
    layers: list[nn.Module] = []
    width = 3
    for out, count in _VGG16:
        layers += [nn.MaxPool2d(2, 2)] if layers else []
        for _ in range(count):
            layers += [nn.Conv2d(width, out, 3, padding=1), nn.ReLU()]
            width = out
    return nn.Sequential(*layers)
