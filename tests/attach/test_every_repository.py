"""Three lines attach D2 to every repository, and none of the repository's own behaviour is lost."""

import copy
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mimics.page import attached
from mimics.workplace import some_points
from repositories import MIMICS, VARIANTS, run, saved, snapshot

from d2_plugin import D2Config
from d2_plugin.protocol import Backbone
from d2_plugin.rasterizer import rasterize
from d2_plugin.registry import ADAPTERS, load
from d2_plugin.testing import Example, check_backbone


def same(a: SimpleNamespace, b: SimpleNamespace) -> bool:
    one, other = snapshot(a), snapshot(b)
    assert one
    return one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)


def resuming(hooks: type, state: dict) -> type:
    """D2Hooks whose `attach` goes on from a state, as one line after the first does; not in a stage before."""

    class Resuming(hooks):
        @classmethod
        def attach(cls, *arguments, **options):
            d2 = hooks.attach(*arguments, **options)
            d2.load_state_dict(state)
            return d2

    return Resuming


@pytest.mark.parametrize("name", MIMICS)
class TestTraining:
    def test_all_hooks_off_is_bitwise_the_bare_loop(self, name: str, workplace: Path) -> None:
        (workplace / "d2.toml").write_text(D2Config().to_toml())
        assert same(run(name, stop=15), run(name, attached(MIMICS[name], name), stop=15))

    @pytest.mark.usefixtures("workplace")
    def test_a_resumed_run_is_bitwise_the_uninterrupted_one(self, name: str) -> None:
        source = attached(MIMICS[name], name)
        whole, first = run(name, source, stop=17), run(name, source, stop=11)
        assert {entry.hook for entry in whole.d2.trace} == {"densify", "prune", "depth_loss"}
        assert all(value.isfinite().all() for value in snapshot(whole).values())
        checkpoint, state = (saved(name, first), 11), copy.deepcopy(first.d2.state_dict())
        forgetful = run(name, source, checkpoint=copy.deepcopy(checkpoint), stop=17)
        source.D2Hooks = resuming(source.D2Hooks, state)
        assert same(whole, run(name, source, checkpoint=checkpoint, stop=17))
        assert not same(whole, forgetful), "D2's state does not matter: this could not fail"


@pytest.mark.parametrize("name", VARIANTS)
class TestAdapter:
    def test_the_slice_draws_what_the_repository_draws(self, name: str) -> None:
        standing = VARIANTS[name]()
        for camera in standing.cameras:
            view = standing.adapter.view(camera)
            splats = standing.adapter.slice_at(view)
            own = rasterize(splats, torch.zeros(len(splats.means), 1), view, standing.adapter.settings)
            assert bool((own.alpha > 0.3).any())
            torch.testing.assert_close(own.depth_sum, standing.draw(camera), rtol=1e-4, atol=1e-4)

    def test_it_is_registered_and_keeps_the_public_contract(self, name: str) -> None:
        def make() -> Example:
            made = VARIANTS[name]()
            return Example(made.adapter, made.cameras, optimizers=made.optimizers, grow=next(iter(made.edits.values())))

        assert isinstance(make().backbone, load(ADAPTERS, name.split()[0]))
        assert isinstance(make().backbone, Backbone)
        assert {"moments", "grow"} <= set(check_backbone(make))

    @settings(max_examples=12, deadline=None)
    @given(data=st.data())
    def test_rows_are_followed_through_any_edits(self, name: str, data: st.DataObject) -> None:
        """Rows are numbered anew before every edit; the reports to listeners must lead back to the numbers."""
        standing, reports = VARIANTS[name](), []
        adapter = standing.adapter
        adapter.on_resize(reports.append)
        edits = standing.edits | {
            "insert": lambda: adapter.insert(some_points(3)),
            "d2 removes": lambda: adapter.remove(torch.arange(len(adapter)) % 5 == 1),
        }
        for action in data.draw(st.lists(st.sampled_from([*edits]), max_size=8)):
            numbers = torch.arange(float(len(adapter)))
            parts = standing.tables()
            for part, values in zip(parts, numbers.split([len(part) for part in parts])):
                part.copy_(values)
            reports.clear()
            edits[action]()
            count, index = len(adapter), torch.arange(len(numbers))
            for report in reports:
                index = torch.where(report >= 0, index[report.clamp(min=0)], -1)
            now = torch.cat(standing.tables())
            assert len(now) == len(index) == count
            assert torch.equal(now[index >= 0], numbers[index[index >= 0]])

    def test_an_insertion_keeps_the_densification_evidence(self, name: str) -> None:
        standing = VARIANTS[name]()
        adapter = standing.adapter
        if standing.evidence is not None:
            standing.evidence().copy_(torch.arange(60.0))
            assert adapter.insert(some_points(5)) == 5
            assert torch.equal(standing.evidence(), torch.cat([torch.arange(60.0), torch.zeros(5)]))
            return
        model = adapter.gaussians
        model.omegamask = torch.ones(len(adapter), 1)  # of spacetime
        before = {kind: torch.rand_like(getattr(model, kind)) for kind in adapter.evidence}
        vars(model).update({kind: value.clone() for kind, value in before.items()})
        assert adapter.insert(some_points(5)) == 5
        for kind, old in before.items():
            new = torch.full((5, *old.shape[1:]), adapter.evidence[kind])
            assert torch.equal(getattr(model, kind), torch.cat([old, new])), kind
