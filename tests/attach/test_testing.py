"""`check_backbone` passes what keeps the contract and names, in a sentence, each way to break it."""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from tiny import BACKBONES, bend_field, make_adapter, make_model, make_views
from torch import Tensor
from torch.optim import Optimizer

from d2_plugin.adapters.watched import WatchedModel
from d2_plugin.backbones.densify import grow
from d2_plugin.protocol import Points, RasterSettings, Render, View
from d2_plugin.testing import CHECKS, ContractError, Example, check_backbone


def make(backbone: str = "yang4d", temporal: bool = True) -> Example:
    """An example of a bundled backbone with everything that can be checked."""
    model = bend_field(make_model(backbone=backbone, temporal=temporal), 0.05)

    def split_some() -> None:
        model.gaussians.statistics["seen"].fill_(1)
        model.gaussians.statistics["screen_gradient"][:9] = 1
        grow(model, model.settings.densify, torch.Generator().manual_seed(0))

    return Example(
        make_adapter(model),
        cameras=make_views(),
        optimizers=[model.gaussians.optimizer],
        render=lambda view: model.render(view),
        grow=split_some,
        state_dict=model.state_dict,
        load_state_dict=model.load_state_dict,
    )


@pytest.mark.parametrize("temporal", [True, False])
@pytest.mark.parametrize("backbone", BACKBONES)
def test_the_bundled_backbones_keep_the_contract(backbone: str, temporal: bool) -> None:
    assert set(check_backbone(lambda: make(backbone, temporal))) == {*CHECKS, "state"}


def test_what_rounding_leaves_in_a_last_row_is_no_mistake() -> None:
    """As torch.linalg.inv leaves it in float32; nor is a pose in float64."""

    def make_rounded() -> Example:
        example = make()
        rounded = torch.tensor([1.5e-8, 0, -1.5e-8, 0]).expand(4, 4) * torch.eye(4)[3][:, None]
        noise = torch.tensor([[0, 0, 0], [0, 0, 0], [1.5e-8, 0, 0]])
        shift = {"T_camera_world": lambda v: (v.T_camera_world + rounded).double(), "K": lambda v: v.K + noise}
        with_view(**shift)(example.backbone)
        return example

    assert check_backbone(make_rounded)


def test_what_the_example_lacks_is_not_checked() -> None:
    made = check_backbone(lambda: Example(make().backbone, make_views()))
    assert set(CHECKS) - set(made) == {"moments", "grow", "rendered depth"}
    assert "state" not in made


def broken(change: Callable[[WatchedModel], None]) -> str:
    """What `check_backbone` says of the Yang-style backbone after `change` of its adapter."""

    def make_broken() -> Example:
        example = make()
        change(example.backbone)
        return example

    with pytest.raises(ContractError) as caught:
        check_backbone(make_broken)
    assert caught.value.violations
    assert all("\n" not in sentence for sentence in caught.value.violations)
    return str(caught.value)


def same(value: object) -> object:
    return value


def changed(name: str, back: Callable = same, given: Callable = same) -> Callable[[WatchedModel], None]:
    """An adapter one of whose methods gets, or gives back, something else."""

    def apply(adapter: WatchedModel) -> None:
        inner = getattr(adapter, name)
        setattr(adapter, name, lambda value: back(inner(given(value))))

    return apply


def with_view(**changes: Callable[[View], object]) -> Callable[[WatchedModel], None]:
    return changed("view", back=lambda view: replace(view, **{name: make(view) for name, make in changes.items()}))


with_slice = partial(changed, "slice_at")
with_insert = partial(changed, "insert", same)
with_report = partial(changed, "_report", same)


def after_remove(change: Callable[[Optimizer, Mapping[str, Tensor]], None]) -> Callable[[WatchedModel], None]:
    """An adapter that does something to the optimizer after a removal; gets the first moments from before."""

    def apply(adapter: WatchedModel) -> None:
        remove = adapter.remove

        def changed(mask: Tensor) -> None:
            optimizer = adapter.model.gaussians.optimizer
            before = {g["name"]: optimizer.state[g["params"][0]]["exp_avg"].clone() for g in optimizer.param_groups}
            remove(mask)
            change(optimizer, before)

        adapter.remove = changed

    return apply


def silent(adapter: WatchedModel) -> None:
    adapter._listeners = []
    adapter.on_resize = lambda listener: None


def one_listener(adapter: WatchedModel) -> None:
    adapter.on_resize = lambda listener: setattr(adapter, "_listeners", [listener])


def early(adapter: WatchedModel) -> None:
    report, select = adapter._report, type(adapter.model).select
    adapter.model.select = lambda index: (report(index), select(adapter.model, index))


def stale(optimizer: Optimizer, before: Mapping[str, Tensor]) -> None:
    """Moments of the first rows stay in front, whichever rows are kept."""
    for group in optimizer.param_groups:
        moments = optimizer.state[group["params"][0]]["exp_avg"]
        moments.copy_(before[group["name"]][: len(moments)])


def draws(points: Points) -> Points:
    torch.rand(1)
    return points


def refuses(points: Points) -> Points:
    raise RuntimeError("no room")


def divided(maps: tuple[Tensor, Tensor] | None) -> tuple[Tensor, Tensor] | None:
    return maps and (maps[0] / (maps[1] + 1e-6), maps[1])


def any_camera(adapter: WatchedModel) -> None:
    kept: list[tuple[Tensor, Tensor]] = []
    rendered = adapter.rendered

    def remember(view: View, render: Render) -> None:
        rendered(view, render)
        kept[:] = [(render.depth_sum, render.alpha)]

    adapter.rendered = remember
    adapter.rendered_depth = lambda view: kept.pop() if kept else None


def last_only(adapter: WatchedModel) -> None:
    rendered = adapter.rendered

    def remember(view: View, render: Render) -> None:
        adapter._renders.clear()
        rendered(view, render)

    adapter.rendered = remember


def swaps_a_batch(adapter: WatchedModel) -> None:
    """Hands out the renders of a batch in the wrong order."""
    rendered_depth, rendered = adapter.rendered_depth, adapter.rendered
    views: list[View] = []

    def remember(view: View, render: Render) -> None:
        if render.alpha.requires_grad:
            views.append(view)
        rendered(view, render)

    def wrong(view: View) -> object:
        others = [other for other in views[-2:] if other is not view]
        return rendered_depth(view if view not in views or not others else others[0])

    adapter.rendered, adapter.rendered_depth = remember, wrong


MIRROR = torch.diag(torch.tensor([1.0, -1, 1, 1]))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (with_view(T_camera_world=lambda view: view.T_camera_world.T), "the last row of T_camera_world is not 0 0 0 1"),
        (with_view(T_camera_world=lambda view: MIRROR @ view.T_camera_world), "mirrors the world"),
        (with_view(T_camera_world=lambda view: view.T_camera_world * 2), "is not orthonormal"),
        (with_view(K=lambda view: -view.K), "positive focal lengths"),
        (with_view(camera=lambda view: int(view.camera[3:])), "the camera of a view must be text"),
        (with_view(camera=lambda view: "one", frame=lambda view: 0), "6 cameras share 1 keys"),
        (with_slice(lambda s: s._replace(means=s.means.detach())), "means of a slice have no gradient"),
        (with_slice(lambda s: s._replace(means=s.means + torch.rand(1))), "another answer when asked twice"),
        (with_slice(lambda s: s._replace(opacities=s.opacities * 4 - 1)), "outside 0..1"),
        (with_slice(lambda s: s._replace(covariances=s.covariances[:, [0, 3, 5, 1, 2, 4]])), "negative eigenvalue"),
        (with_slice(lambda s: s._replace(rows=torch.zeros_like(s.rows))), "name one Gaussian twice"),
        (with_slice(lambda s: s._replace(rows=s.rows + 1000)), "rows of a slice must be int64 in 0.."),
        (with_slice(lambda s: s._replace(means=s.means[:, :2])), r"means of a slice has shape \(60, 2\), expected"),
        (with_slice(lambda s: s._replace(means=s.means - torch.tensor([0, 0, 99.0]))), "cam0' sees no Gaussian"),
        (with_slice(lambda s: s._replace(means=s.means * float("nan"))), "is not finite"),
        (silent, "insert changes 60 Gaussians to 68 without a report to on_resize"),
        (silent, "own densification goes from 60 to .* without a report"),
        (one_listener, "reported to one listener only"),
        (early, "report N_new rows, after the change"),
        (with_report(lambda index: index.flip(0)), "are not those of the rows that the report names"),
        (with_report(lambda index: index + 100), "reports rows outside -1..59"),
        (with_report(lambda index: index >= 0), "reports torch.bool .* expected an index"),
        (changed("remove", given=torch.logical_not), "remove was given 20 rows and took 40"),
        (changed("insert", back=lambda count: count + 1), "insert returns 9 but 8 Gaussians were added"),
        (with_insert(lambda p: p._replace(positions=p.positions + 0.7)), "are not where their points are"),
        (with_insert(lambda p: p._replace(scales=p.scales * 5)), "have a standard deviation of .* asked for"),
        (with_insert(lambda p: p._replace(opacities=p.opacities * 0.1)), "have an opacity of .* asked for"),
        (after_remove(lambda optimizer, _: optimizer.state.clear()), "has lost its state"),
        (after_remove(stale), "does not stay on its row"),
        (after_remove(lambda optimizer, _: optimizer.param_groups.clear()), "remove: a slice has no gradient to what"),
        (with_insert(draws), "the global random state changes"),
        (changed("rendered_depth", back=divided), "depth_sum is not the slice's"),
        (any_camera, "render of one camera for another"),
        (last_only, "rendered_depth knows the last render alone"),
        (swaps_a_batch, "the render of one camera of a batch for another"),
        (with_insert(refuses), "insert: the backbone raised RuntimeError: no room"),
        (with_insert(lambda p: p.select(torch.arange(0))), "insert adds none of 8 points"),
        (with_report(lambda index: index.flip(0) if len(index) == 69 else index), "own densification the means of"),
        (with_report(lambda index: index + 60 * (len(index) == 69)), "own densification reports rows outside -1..77"),
    ],
)
def test_each_violation_gets_its_sentence(change: Callable[[WatchedModel], None], sentence: str) -> None:
    assert re.search(sentence, broken(change))


def test_members_that_are_missing_are_named_first() -> None:
    with pytest.raises(ContractError, match=r"the backbone has no slice_at\(\)"):
        check_backbone(lambda: Example(SimpleNamespace(settings=RasterSettings()), make_views()))


def test_a_state_that_forgets_something_is_noticed() -> None:
    def forgetful() -> Example:
        example = make()

        def load(state: dict) -> None:
            example.load_state_dict(state)
            with torch.no_grad():
                example.backbone.model.gaussians["positions"].mul_(1.01)

        return replace(example, load_state_dict=load)

    with pytest.raises(ContractError, match="a resumed run would differ"):
        check_backbone(forgetful)
