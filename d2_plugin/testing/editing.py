"""Checks of what the hooks change: insertion and removal, the reports of them, optimizer rows, checkpoints."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import torch
from torch import Tensor

from d2_plugin.gaussians.nearest import nearest
from d2_plugin.hooks.expected import mistake_of
from d2_plugin.protocol import Backbone, Points, Splats, View, covariance_matrices
from d2_plugin.testing.example import Check, Example, some_points, some_rows

PLACED = 0.5
"""Share of inserted Gaussians that must be where they were asked for: a deformation field cannot always be inverted."""


@dataclass
class _Listener:
    """Remembers reports and how many Gaussians there were when each one came."""

    backbone: Backbone
    reports: list[Tensor] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)

    def __call__(self, index: Tensor) -> None:
        self.reports.append(index)
        self.counts.append(len(self.backbone))

    def total(self, count: int) -> Tensor:
        """All reports as one index from the present rows to the `count` rows before them."""
        total = torch.arange(count)
        for index in self.reports:
            index = index.cpu()
            total = torch.where(index >= 0, total[index.clamp(min=0)], index) if len(total) else index
        return total


def _edited(example: Example, what: str, edit: Callable[[], object]) -> tuple[list[str], Tensor]:
    """Violations of an edit's report, and its index; every kept Gaussian must look as before."""
    backbone, view = example.backbone, example.views[0]
    count = len(backbone)
    with torch.no_grad():
        before = backbone.slice_at(view)
    listener, second = _Listener(backbone), _Listener(backbone)
    backbone.on_resize(listener)
    backbone.on_resize(second)
    edit()
    if len(listener.reports) != len(second.reports):
        return [f"{what} is reported to one listener only: on_resize must keep them all"], torch.empty(0)
    if not listener.reports and len(backbone) != count:
        return [f"{what} changes {count} Gaussians to {len(backbone)} without a report to on_resize"], torch.empty(0)
    for index, was, now in zip(listener.reports, [count, *listener.counts], listener.counts):
        if mistake := mistake_of(what, index, was, now):
            return [mistake], index
    index = listener.total(count)
    return list(_unchanged(example, what, before, index)), index


def _unchanged(example: Example, what: str, before: Splats, index: Tensor, loose: bool = False) -> Iterator[str]:
    """Each kept Gaussian, found through the index, must be the one it was; loosely, most are about where they were."""
    with torch.no_grad():
        after = example.backbone.slice_at(example.views[0])
    old_rows, new_rows = before.rows.cpu(), after.rows.cpu()
    place = torch.full((max(len(index), int(old_rows.max()) + 1 if len(old_rows) else 0) + 1,), -1)
    place[old_rows] = torch.arange(len(old_rows))
    source = index[new_rows]
    was = torch.where(source >= 0, place[source.clamp(min=0)], source)
    kept = was >= 0
    least, near = (0.5, 0.1 * float(before.means.detach().std())) if loose else (1.0, 1e-6)
    for name, old, new in zip(Splats._fields[: 1 if loose else 3], before, after):
        same = torch.isclose(new.cpu()[kept], old.cpu()[was[kept]], rtol=1e-4, atol=near)
        if kept.any() and same.double().mean() < least:
            yield f"after {what} the {name} of kept Gaussians are not those of the rows that the report names"
            return


def _insert(example: Example) -> Iterator[str]:
    backbone, view = example.backbone, example.views[-1]
    points, count = some_points(example, view), len(example.backbone)
    added: list[int] = []
    mistakes, index = _edited(example, "insert", lambda: added.append(backbone.insert(points)))
    if mistakes:
        yield from mistakes
        return
    if added[0] != len(backbone) - count:
        yield f"insert returns {added[0]} but {len(backbone) - count} Gaussians were added"
    if not added[0] and len(points.positions):
        yield f"insert adds none of {len(points.positions)} points beside Gaussians that a camera sees"
    elif added[0] and int((index < 0).sum()) != added[0]:
        yield f"insert adds {added[0]} Gaussians but reports {int((index < 0).sum())} new rows (-1)"
    elif added[0]:
        yield from _placed(example, view, points, index)


def _placed(example: Example, view: View, points: Points, index: Tensor) -> Iterator[str]:
    """At their own time new Gaussians must be what was asked for."""
    with torch.no_grad():
        splats = example.backbone.slice_at(view)
    new = (index[splats.rows.cpu()] < 0).to(splats.means.device)
    if not new.any():
        yield "inserted Gaussians are not there at the time of their points"
        return
    distance, _ = nearest(points.positions.to(splats.means), splats.means[new], 1)
    if (distance < 2 * points.scales.mean()).double().mean() < PLACED:
        yield "inserted Gaussians are not where their points are, at the time of their points"
    variances = covariance_matrices(splats.covariances[new].double()).diagonal(dim1=-2, dim2=-1)
    wide = variances.mean(-1).sqrt().median().item()
    asked = points.scales.median().item()
    if not 0.5 * asked < wide < 2 * asked:
        yield f"inserted Gaussians have a standard deviation of {wide:.4g}, asked for {asked:.4g} in world units"
    opacity, wanted = splats.opacities[new].median().item(), points.opacities.median().item()
    if abs(opacity - wanted) > 0.1:
        yield f"inserted Gaussians have an opacity of {opacity:.3f} at their own time, asked for {wanted:.3f}"


def _insert_nothing(example: Example) -> Iterator[str]:
    count = len(example.backbone)
    nothing = some_points(example, example.views[0]).select(torch.arange(0))
    if example.backbone.insert(nothing) != 0 or len(example.backbone) != count:
        yield "inserting no points must change nothing and return 0"


def _remove(example: Example) -> Iterator[str]:
    mask, count = some_rows(example), len(example.backbone)
    mistakes, index = _edited(example, "remove", lambda: example.backbone.remove(mask))
    yield from mistakes
    if not mistakes and len(example.backbone) != count - int(mask.sum()):
        yield f"remove was given {int(mask.sum())} rows and took {count - len(example.backbone)}: True means delete"
    elif not mistakes and set(index.tolist()) != set(torch.nonzero(~mask.cpu()).squeeze(-1).tolist()):
        yield "remove deletes other rows than those whose mask is True"


def _grow(example: Example) -> Iterator[str]:
    assert example.grow is not None  # see `NEEDS`
    what, count, listener = "the backbone's own densification", len(example.backbone), _Listener(example.backbone)
    with torch.no_grad():
        before = example.backbone.slice_at(example.views[0])
    example.backbone.on_resize(listener)
    example.grow()
    grown = len(example.backbone)
    reports = zip(listener.reports, [count, *listener.counts], listener.counts)
    if listener.reports:
        mistakes = [mistake for report in reports if (mistake := mistake_of(what, *report))]
        yield from mistakes or _unchanged(example, what, before, listener.total(count), loose=True)
    elif grown != count:
        yield f"{what} goes from {count} to {grown} without a report to on_resize"
    else:
        yield "grow of the example changes nothing: make it split, clone or prune"


def _moments(example: Example) -> Iterator[str]:
    """Every optimizer state with one row per Gaussian is painted with row numbers, and must follow its Gaussian."""
    count = len(example.backbone)
    _paint(example, count)
    mistakes, index = _edited(example, "remove", lambda: example.backbone.remove(some_rows(example)))
    yield from mistakes
    if mistakes:
        return
    yield from _painted(example, "remove", index)
    _paint(example, len(example.backbone))
    points = some_points(example, example.views[0])
    mistakes, index = _edited(example, "insert", lambda: example.backbone.insert(points))
    if not mistakes:
        yield from _painted(example, "insert", index)


def _paint(example: Example, count: int) -> None:
    """Give every per-Gaussian parameter a state, and write row number + 1 into it."""
    for optimizer in {id(o): o for o, _ in example.parameters}.values():
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                parameter.grad = torch.zeros_like(parameter)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    numbers = torch.arange(1.0, count + 1)
    for optimizer, parameter in example.parameters:
        for value in _row_states(optimizer, parameter, count):
            value.copy_(numbers.to(value).view(-1, *[1] * (value.ndim - 1)).expand_as(value))


def _painted(example: Example, what: str, index: Tensor) -> Iterator[str]:
    count = len(example.backbone)
    expected = index + 1.0  # a new row, -1, holds zero
    means, trained = example.backbone.slice_at(example.views[0]).means, [p for _, p in example.parameters]
    held = [p for p in trained if p.requires_grad and means.requires_grad]
    if not held or set(torch.autograd.grad(means.sum(), held, allow_unused=True)) == {None}:
        yield f"{what}: a slice has no gradient to what the optimizer holds: put new parameters into its groups"
    for number, (optimizer, parameter) in enumerate(example.parameters):
        if not parameter.requires_grad or parameter.ndim == 0:
            continue
        states = list(_row_states(optimizer, parameter, count))
        if parameter.shape[0] == count and not states:
            yield f"{what}: parameter {number} of the optimizer has lost its state, and starts without momentum"
        for value in states:
            column = value.flatten(1)[:, 0] if value.ndim > 1 else value
            if not torch.equal(column.cpu(), expected):
                yield f"{what}: optimizer state of parameter {number} does not stay on its row (new rows start at zero)"
                return


def _row_states(optimizer: torch.optim.Optimizer, parameter: Tensor, count: int) -> Iterator[Tensor]:
    for value in optimizer.state.get(parameter, {}).values():
        if torch.is_tensor(value) and value.ndim and value.shape[0] == count and parameter.shape[0] == count:
            yield value


def state_round_trip(first: Example, second: Example) -> Iterator[str]:
    """A model that was edited, saved, and loaded into another must be itself."""
    if first.state_dict is None or second.load_state_dict is None:
        return
    first.backbone.remove(some_rows(first))
    first.backbone.insert(some_points(first, first.views[0]))
    second.load_state_dict(first.state_dict())
    with torch.no_grad():
        for view in first.views:
            pairs = zip(first.backbone.slice_at(view), second.backbone.slice_at(view))
            if any(a.shape != b.shape or not torch.equal(a, b) for a, b in pairs):
                yield "a model that is loaded from state_dict is not the one that was saved: a resumed run would differ"
                return


EDITING: dict[str, Check] = {
    "insert": _insert,
    "insert nothing": _insert_nothing,
    "remove": _remove,
    "moments": _moments,
    "grow": _grow,
}
