"""Uses the installed package as somebody would who never saw the checkout: `python -P smoke.py CHECKOUT`.

CHECKOUT is where nothing may be loaded from; only its page docs/your-backbone.md is read, for the example on it.
"""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import torch

import d2_plugin
from d2_plugin import registry
from d2_plugin.compiler import prebuilt
from d2_plugin.protocol import View
from d2_plugin.rasterizer import Splats, rasterize
from d2_plugin.testing import check_backbone


def say(line: str) -> None:
    """One line of progress."""
    sys.stdout.write(f"smoke test: {line}\n")


def commands() -> None:
    """The `d2` command answers, and with the version that was installed."""
    for word in ("--help", "--version", "doctor"):
        answer = subprocess.run(["d2", word], check=True, capture_output=True, text=True).stdout
        assert answer.strip(), f"`d2 {word}` prints nothing"
        if word == "--version":
            assert version("d2-4dgs") in answer, f"`d2 --version` says {answer.strip()}"
    say("d2 --help, --version and doctor answer")


def modules(checkout: Path) -> None:
    """Everything that is registered can be loaded, and nothing comes from the checkout."""
    importlib.import_module("d2_plugin.adapters.yang4d")
    importlib.import_module("d2_plugin.backbones.deform")
    names = [(group, name) for group in (registry.BACKBONES, registry.ADAPTERS) for name in registry.names(group)]
    for group, name in names:
        registry.load(group, name)
    assert len(names) > 2, f"only {names} are registered"
    files = {name: getattr(module, "__file__", None) for name, module in sys.modules.items() if "d2_plugin" in name}
    astray = {name: file for name, file in files.items() if file and checkout in Path(file).resolve().parents}
    assert not astray, f"loaded from the checkout: {astray}"
    say(f"{len(names)} backbones and adapters load from {Path(d2_plugin.__file__).parent}")


def views(count: int = 2) -> list[View]:
    """Cameras side by side, looking along z."""
    intrinsics = torch.tensor([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]])
    poses = torch.eye(4).repeat(count, 1, 1)
    poses[:, 0, 3] = torch.linspace(-0.2, 0.2, count)
    return [View(f"cam{i}", 0, 0.0, pose, intrinsics, 32, 24) for i, pose in enumerate(poses)]


def kernels() -> None:
    """The installed sources compile; a handful of Gaussians renders in float32 (kernels) as in float64 (torch)."""
    count = 5
    means = torch.stack([torch.linspace(-0.5, 0.5, count), torch.zeros(count), torch.full((count,), 3.0)], -1)
    covariances = torch.tensor([0.02, 0, 0, 0.02, 0, 0.02]).expand(count, 6)
    splats = Splats(means, covariances, torch.full((count,), 0.7), torch.arange(count))
    colors = torch.linspace(0, 1, 3 * count).view(count, 3)
    render = rasterize(splats, colors, views()[0])
    exact = rasterize(Splats(*(part.double() for part in splats[:3]), splats.rows), colors.double(), views()[0])
    torch.testing.assert_close(render.color.double(), exact.color, atol=1e-4, rtol=1e-3)
    built = list(Path(os.environ["D2_CACHE"]).rglob("*.so"))
    if (prebuilt.FOLDER / prebuilt.CHECKSUMS).is_file():
        assert not built, f"compiled, although the wheel brought the kernels: {built}"
        say(f"{count} Gaussians render with the kernels of the wheel, for {prebuilt.usable()[0]}")
        return
    assert built, "no kernel was compiled: is there a C++17 compiler?"
    say(f"{count} Gaussians render; {', '.join(file.name.split('-')[0] for file in built)} compiled")


def example(checkout: Path) -> None:
    """The backbone on docs/your-backbone.md keeps the contract."""
    page = (checkout / "docs" / "your-backbone.md").read_text(encoding="utf-8")
    block = re.search(r"```python\n(.*?)```", page, re.DOTALL)
    assert block, "docs/your-backbone.md has no block of Python"
    names: dict[str, object] = {"__name__": "example"}
    sys.modules["example"] = type(sys)("example")  # dataclasses look their module up
    exec(compile(block[1], "your-backbone.md", "exec"), names)
    make = names["make"]
    assert callable(make), "the example has no function `make`"
    say(f"check_backbone: {', '.join(check_backbone(lambda: make(views())))}")


if __name__ == "__main__":
    tree = Path(sys.argv[1]).resolve()
    commands()
    modules(tree)
    kernels()
    example(tree)
