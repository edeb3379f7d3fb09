"""One evaluation takes at most a share of the light away: holes that nothing stands behind are slow to close."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny import make_trainer

from d2_plugin.config import D2Config, PruneConfig
from d2_plugin.hooks.prune import within_light


def test_the_faintest_go_first_and_the_rest_waits() -> None:
    weight = torch.tensor([5.0, 1.0, 3.0, 0.5, 90.5])
    asked = torch.tensor([True, True, True, True, False])
    assert within_light(asked, weight, 0.05).tolist() == [False, True, True, True, False]
    assert within_light(asked, weight, 0.02).tolist() == [False, True, False, True, False]
    assert within_light(asked, weight, 1.0) is asked


@settings(deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.floats(0, 1e3)), min_size=1, max_size=30), st.floats(0, 0.99))
def test_never_more_than_was_asked_for_and_never_more_light(rows: list[tuple[bool, float]], share: float) -> None:
    asked, weight = torch.tensor([row[0] for row in rows]), torch.tensor([row[1] for row in rows])
    chosen = within_light(asked, weight, share)
    assert not (chosen & ~asked).any()
    assert bool(chosen.any()) == bool(asked.any())
    assert int(chosen.sum()) <= 1 or weight[chosen].double().sum() <= share * weight.double().sum() + 1e-6


def test_the_hook_removes_little_by_little() -> None:
    """With a threshold that condemns everything that is seen."""

    def after_three(light: float) -> int:
        prune = PruneConfig(start=1, every=1, patience=1, tau_p=0.0, light=light)
        trainer = make_trainer(D2Config(prune=prune, views_per_evaluation=3))
        trainer.run(until=3)
        return trainer.d2.log.removed

    assert 0 < after_three(0.05) < after_three(1.0)


def test_short_runs_leave_time_between_removals() -> None:
    """Holes close, and what is misplaced moves, at a pace that counts iterations, not parts of the run."""
    assert all(PruneConfig.for_iterations(length).every >= 10 for length in (10, 20, 40, 150, 199))
