"""docs/your-backbone.md is true: its example is short, keeps the contract, and is guided by the hooks."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
from tiny import ALL_HOOKS, TinyFrames, TinyStore, make_model, make_views

from d2_plugin import D2Error, D2Hooks, registry
from d2_plugin.gaussians.photometric import photometric_loss
from d2_plugin.rasterizer import rasterize
from d2_plugin.testing import check_backbone

PAGE = Path(__file__).resolve().parents[2] / "docs" / "your-backbone.md"
LONGEST = 60


def code_of_the_page() -> str:
    """The first block of Python on the page."""
    return re.search(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)[1]


@pytest.fixture
def example() -> ModuleType:
    """The page's example as a module."""
    module = ModuleType("drift")
    exec(compile(code_of_the_page(), str(PAGE), "exec"), module.__dict__)
    return module


def test_the_example_has_at_most_sixty_lines() -> None:
    lines = code_of_the_page().splitlines()
    assert len(lines) <= LONGEST
    assert max(map(len, lines)) <= 120


def test_the_example_keeps_the_contract(example: ModuleType) -> None:
    made = check_backbone(lambda: example.make(make_views()))
    assert {"views", "slices", "gradients", "insert", "remove", "moments"} <= set(made)


def test_the_hooks_guide_the_example(example: ModuleType) -> None:
    torch.manual_seed(0)
    frames, model = TinyFrames(), example.make(make_views()).backbone
    d2 = D2Hooks.from_config(ALL_HOOKS, backbone=model, store=TinyStore())
    for step in range(1, 16):
        view = frames.views[step % len(frames.views)]
        render = rasterize(model.slice_at(view), model.rows["colors"], view)
        loss = photometric_loss(render.color, frames.image(step % len(frames.views)))
        (loss + d2.loss(step, view)).backward()
        model.optimizer.step()
        model.optimizer.zero_grad()
        d2.step(step)
    done = {(entry.hook, entry.action) for entry in d2.trace}
    assert {("densify", "insert"), ("depth_loss", "loss")} <= done
    assert all(torch.isfinite(value).all() for value in model.rows.values())


def test_the_page_names_what_there_is() -> None:
    text = PAGE.read_text()
    for group in (registry.BACKBONES, registry.ADAPTERS):
        assert f"{group} =" in text
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        ast.parse(block)


class TestEntryPoints:
    @pytest.fixture
    def installed(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Somebody else's distribution with a backbone and an adapter, as pip would leave it."""
        info = tmp_path / "their_package-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: their-package\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(
            "[d2_plugin.backbones]\ntheirs = their_module\n[d2_plugin.adapters]\ntheirs = their_module:adapt\n"
        )
        (tmp_path / "their_module.py").write_text(
            "from d2_plugin.adapters.yang4d import Yang4DAdapter as adapt\n"
            "from d2_plugin.backbones.yang4d import Trainer, TrainSettings, create, settings_from\n"
        )
        monkeypatch.syspath_prepend(tmp_path)
        yield
        sys.modules.pop("their_module", None)

    @pytest.mark.usefixtures("installed")
    def test_somebody_elses_backbone_is_found_by_name(self) -> None:
        assert "theirs" in registry.names(registry.BACKBONES)
        module = registry.load(registry.BACKBONES, "theirs")
        assert all(hasattr(module, name) for name in ("create", "settings_from", "Trainer", "TrainSettings"))
        assert len(registry.load(registry.ADAPTERS, "theirs")(make_model())) == 60

    def test_without_it_the_name_is_refused_with_those_that_there_are(self) -> None:
        with pytest.raises(D2Error, match=r"unknown backbone 'theirs': have deform, .*yang4d"):
            registry.load(registry.BACKBONES, "theirs")
