"""The contract as a test: `check_backbone(make)` says in one sentence each what a backbone's adapter gets wrong.

    from d2_plugin.testing import Example, check_backbone

    def make() -> Example:                          # a new small model each time, seen by its cameras
        model = MyModel(...)
        return Example(MyAdapter(model), cameras=my_cameras, optimizers=[model.optimizer])

    def test_my_adapter_keeps_the_contract() -> None:
        check_backbone(make)

No test framework is needed. The bundled backbones pass the same checks; docs/your-backbone.md has an example from the
first line to this test.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from d2_plugin.errors import D2Error
from d2_plugin.protocol import RasterSettings
from d2_plugin.testing.editing import EDITING, state_round_trip
from d2_plugin.testing.example import Check, Example
from d2_plugin.testing.reading import READING
from d2_plugin.values import counted

__all__ = ["CHECKS", "ContractError", "Example", "check_backbone"]

CHECKS: dict[str, Check] = READING | EDITING
"""All checks of one example by name, in the order in which they are made."""

NEEDS = {"moments": "optimizers", "grow": "grow", "rendered depth": "render"}
"""The part of an `Example` without which a check is not made."""


class ContractError(D2Error):
    """What a backbone's adapter gets wrong; `violations` holds one sentence for each."""

    longest = 10_000  # it lists what is wrong

    def __init__(self, violations: Sequence[str]) -> None:
        self.violations = tuple(violations)
        super().__init__("\n".join(violations))


def check_backbone(make: Callable[[], Example]) -> tuple[str, ...]:
    """Try the whole contract of `d2_plugin.protocol.Backbone`, each check on a new example.

    Returns:
        The names of the checks that were made; those that need a part of the example that is absent are left out.

    Raises:
        ContractError: with one sentence for each violation, all of them together.
    """
    missing = list(_missing_members(make()))
    if missing:
        raise ContractError(missing)
    violations: list[str] = []
    made = []
    for name, check in CHECKS.items():
        example = make()
        if name not in NEEDS or getattr(example, NEEDS[name]):
            made.append(name)
            violations += _guarded(name, check(example))
    if (example := make()).state_dict and example.load_state_dict:
        made.append("state")
        violations += _guarded("state", state_round_trip(example, make()))
    if violations:
        raise ContractError(violations)
    return tuple(made)


def _guarded(name: str, sentences: Iterator[str]) -> list[str]:
    """A check's sentences; an exception of the backbone is one more, and never hides the others."""
    violations: list[str] = []
    try:
        violations.extend(sentences)
    except Exception as error:  # a third party's code may raise anything, and the report must go on
        violations.append(f"{name}: the backbone raised {type(error).__name__}: {error}")
    return violations


def _missing_members(example: Example) -> Iterator[str]:
    for name in ("__len__", "view", "slice_at", "insert", "remove", "on_resize"):
        if not callable(getattr(example.backbone, name, None)):
            yield f"the backbone has no {name}(): see d2_plugin.protocol.Backbone"
    if not isinstance(getattr(example.backbone, "settings", None), RasterSettings):
        yield "settings must be a RasterSettings, the constants of the backbone's own rasterizer"
    if len(example.cameras) < 2:
        yield f"the example has {counted(len(example.cameras), 'camera')}: give at least 2"
