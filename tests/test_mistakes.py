"""The library in the hands of somebody who mixes things up: a D2Error with what was expected and what was got."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from tiny import ALL_HOOKS, TinyStore, make_adapter, make_model, make_trainer, make_views

from d2_plugin import D2Config, D2Error, D2Hooks
from d2_plugin.config import DensifyConfig, PruneConfig
from d2_plugin.protocol import Splats, View


def attached(**changes: Any) -> D2Hooks:
    trainer = make_trainer(ALL_HOOKS)
    assert trainer.d2 is not None
    return trainer.d2


def test_what_is_no_backbone_is_told_what_it_lacks() -> None:
    with pytest.raises(D2Error, match=r"the backbone is a object without settings, __len__, view, slice_at"):
        D2Hooks(D2Config(), object())  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["gsplat", "fudan", "yang4d", "hust4d", "deformable3d", "spacetime", "ex4dgs"])
@pytest.mark.parametrize("model", [(), (object(),), (None, None)], ids=["nothing", "object", "none"])
def test_an_adapter_of_the_wrong_object_says_so(name: str, model: tuple) -> None:
    sentence = r"the adapter 'gsplat' cannot take object .*docstring of GsplatAdapter"
    with pytest.raises(D2Error, match=sentence if (name, len(model)) == ("gsplat", 1) else None):
        D2Hooks.attach({}, name, *model)


@pytest.mark.parametrize("views", [None, [None], [make_views()[0], None]])
def test_no_view_is_no_view(views: Any) -> None:
    with pytest.raises(D2Error, match="got None as a view"):
        attached().loss(1, views)


def test_an_object_that_is_no_camera() -> None:
    with pytest.raises(D2Error, match=r"a str"):
        attached().loss(1, "cam0")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"K": torch.zeros(3, 3)}, "focal lengths 0 and 0, expected positive"),
        ({"K": torch.full((3, 3), torch.nan)}, "K of the view .* not finite"),
        ({"K": torch.eye(4)}, r"K of the view .* is torch.float32 \(4, 4\), expected a plain tensor \(3, 3\)"),
        ({"T_camera_world": None}, r"T_camera_world .* is NoneType, expected a plain tensor \(4, 4\)"),
        ({"width": 0}, "0x24 pixels, expected at least one"),
    ],
)
def test_a_view_that_no_image_has(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(D2Error, match=says):
        attached().loss(1, replace(make_views()[0], **changes))


def test_a_state_of_other_things() -> None:
    d2 = attached()
    with pytest.raises(D2Error, match="has no hooks, views, generator, idle, retired: give what d2.state_dict"):
        d2.load_state_dict({})
    with pytest.raises(D2Error, match="has no hooks"):
        d2.load_state_dict(None)  # type: ignore[arg-type]
    state = d2.state_dict()
    other = state | {"hooks": state["hooks"] | {"prune": {"streak": torch.zeros(3, dtype=torch.int64)}}}
    with pytest.raises(D2Error, match=r"streak of prune in the checkpoint is of 3 Gaussians but the backbone has \d+"):
        d2.load_state_dict(other)
    d2.load_state_dict(state)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("views", 5),
        ("generator", None),
        ("generator", torch.zeros(3)),
        ("idle", [1]),
        ("retired", "x"),
        ("inserted_at", torch.zeros(2, dtype=torch.int32)),
        ("hooks", {"densify": {}, "prune": None, "depth_loss": {}}),
    ],
)
def test_a_state_with_something_else_in_it(name: str, value: Any) -> None:
    d2 = attached()
    with pytest.raises(D2Error, match=r"the state of D2 (does not fit|has)|inserted_at of d2 in the checkpoint"):
        d2.load_state_dict(d2.state_dict() | {name: value})


@pytest.mark.parametrize("step", [None, "x", -1, 1.5, True])
def test_what_is_no_step(step: Any) -> None:
    d2 = attached()
    for call in (lambda: d2.step(step), lambda: d2.loss(step, make_views()[:1])):
        with pytest.raises(D2Error, match="as the step: give the number of the optimizer's step"):
            call()


class InFloat64:
    """A backbone whose Gaussians are float64."""

    def __init__(self) -> None:
        self.inner = make_adapter(make_model())

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def __len__(self) -> int:
        return len(self.inner)

    def slice_at(self, view: View) -> Splats:
        return Splats(*(part.double() if part.is_floating_point() else part for part in self.inner.slice_at(view)))


def test_densify_says_that_it_needs_float32() -> None:
    config = D2Config(densify=DensifyConfig(start=0, every=1), views_per_evaluation=1)
    d2 = D2Hooks(config, InFloat64(), TinyStore())  # type: ignore[arg-type]
    d2.loss(1, make_views())
    with pytest.raises(D2Error, match=r"densify inserts float32 Gaussians and slice_at\(\) returned torch.float64"):
        d2.step(1)


def test_gaussians_that_do_not_fit_each_other() -> None:
    class Torn(InFloat64):
        def slice_at(self, view: View) -> Splats:
            splats = self.inner.slice_at(view)
            return splats._replace(rows=splats.rows[:-1])

    d2 = D2Hooks(D2Config(prune=PruneConfig(start=0, every=1)), Torn(), TinyStore())  # type: ignore[arg-type]
    d2.loss(1, make_views())
    with pytest.raises(D2Error, match=r"slice_at\(\) returned means .*, rows .*, expected M rows each"):
        d2.step(1)
