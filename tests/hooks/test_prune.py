"""Pruning: the paper's scores, written out, what standing in free space adds, and how much may go at once."""

import logging
import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny import HEIGHT, WIDTH, TinyStore, make_adapter, make_model, make_trainer, make_views
from torch import Tensor

from d2_plugin.config import D2Config, DensifyConfig, PruneConfig
from d2_plugin.hooks import prune as module
from d2_plugin.hooks.hook import FREE_SIGMAS, Context
from d2_plugin.hooks.prior import PriorLoader
from d2_plugin.hooks.prune import Prune, Sums, depth_inconsistency, gather, opacity_contribution, within_light
from d2_plugin.hooks.views import ViewSampler
from d2_plugin.plugin import D2Hooks
from d2_plugin.protocol import DepthPrior, Edit, Label, RasterSettings, Splats, View
from d2_plugin.rasterizer import rasterize

EVERY_ONE = PruneConfig(patience=1, light=1, sight=False)


class Fixed:
    """A backbone of Gaussians that stay as they are."""

    settings = RasterSettings()

    def __init__(self, splats: Splats, not_now: int = 0) -> None:
        self.splats, self.count = splats, len(splats.means) + not_now

    def __len__(self) -> int:
        return self.count

    def slice_at(self, view: View) -> Splats:
        return self.splats


def double(view: View) -> View:
    return replace(view, K=view.K.double(), T_camera_world=view.T_camera_world.double())


def context(splats: Splats, views: list[View], prior: DepthPrior) -> Context:
    loader = PriorLoader(SimpleNamespace(prior=lambda camera, frame: prior))
    return Context(1, Fixed(splats), [], loader, torch.Generator(), lambda: views)


def scattered(seed: int) -> Splats:
    """Forty Gaussians before and behind the plane z = 3, float64."""
    g = torch.Generator().manual_seed(seed)
    unit = torch.rand(40, 5, generator=g, dtype=torch.float64)
    means = unit[:, :3] * torch.tensor([3.0, 2, 3]) + torch.tensor([-1.5, -1, 1.5])
    variance = (0.05 + 0.1 * unit[:, 3:4]) ** 2
    covariances = variance * torch.tensor([1.0, 0, 0, 1, 0, 1]).double()
    return Splats(means, covariances, 0.1 + 0.8 * unit[:, 4], torch.arange(40))


def compositing_weights(splats: Splats, view: View) -> Tensor:
    """w_{k,p} [H, W, N]: the image in which every Gaussian has a colour channel of its own."""
    return rasterize(splats, torch.eye(len(splats.means)).double(), view).color


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("with_sigma", [False, True])
def test_the_scores_are_the_papers(seed: int, with_sigma: bool) -> None:
    """E~: sum over Omega^v of w |z - D*| / (D* + eps), over sum of w; O: mean of max w; S = .5 E + .5 (1 - O)."""
    splats, views, prior = scattered(seed), [double(view) for view in make_views()[:3]], TinyStore().prior("", 0)
    error, total, maxima, seen = torch.zeros(4, 40, dtype=torch.float64)
    for view in views:
        w = compositing_weights(splats, view)
        z = splats.means[:, 2]  # the cameras look along z from z = 0
        on = w[prior.labels == Label.VERIFIED]
        error += (on * (z - 3.0).abs() / (3.0 + 1e-8)).sum(0)
        total += on.sum(0)
        maxima += w.amax((0, 1))
        seen += w.amax((0, 1)) > 0
    inconsistency = torch.where(total > 0, (error / (total + 1e-8) / 0.1).clamp(max=1), 0)
    contribution = torch.where(seen > 0, maxima / seen.clamp(min=1), 0)
    score = 0.5 * inconsistency + 0.5 * (1 - contribution)
    torch.testing.assert_close(module.pruning_score(inconsistency, contribution, 0.5), score, rtol=0, atol=0)
    if with_sigma:
        prior = prior._replace(sigma=torch.where(prior.verified, 0.0, torch.inf))
    config = replace(EVERY_ONE, free_space=not with_sigma)  # without sigma no space is known to be free
    found = context(splats, views, prior)
    sums = gather(found.evaluation, 40, config.free_space)
    torch.testing.assert_close(depth_inconsistency(*sums[:2], 0.1), inconsistency, rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(opacity_contribution(sums.maxima, sums.observations), contribution, rtol=1e-7, atol=1e-9)
    edit = Prune(replace(config, tau_p=0.7)).edit(found)
    assert torch.equal(edit.remove, (score > 0.7) & (total > 0))
    assert 0 < int(edit.remove.sum()) < 40


VERIFIED, UNCERTAIN, BEYOND = 5, 16, 27
"""Columns in the middle of three bands: exact, sigma .2 (free up to 1.2 = 3 (1 - 3 x .2)), far beyond 50."""

CAST = {
    "on the surface": (VERIFIED, 3.0),
    "before the surface": (VERIFIED, 1.5),
    "within three sigmas": (UNCERTAIN, 2.0),
    "before three sigmas": (UNCERTAIN, 0.6),
    "before the far": (BEYOND, 10.0),
    "behind the bound": (BEYOND, 60.0),
}

FLOATING = {"before the surface", "before three sigmas", "before the far"}


def bands() -> DepthPrior:
    labels = torch.full((HEIGHT, WIDTH), int(Label.MONO), dtype=torch.uint8)
    labels[:, :11], labels[:, 22:] = Label.VERIFIED, Label.FAR
    depth = torch.where(labels == Label.FAR, 50.0, 3.0)
    sigma = torch.where(labels == Label.MONO, 0.2, torch.where(labels == Label.VERIFIED, 0.0, torch.inf))
    return DepthPrior(depth, labels, sigma=sigma)


def cast(view: View) -> Splats:
    """One translucent Gaussian for each part, about a pixel wide, apart from each other."""
    columns, z = torch.tensor(list(CAST.values())).unbind(-1)
    rows = torch.tensor([6.0, 18.0]).repeat(3)
    centres = torch.stack([columns + 0.5, rows + 0.5, torch.ones(6)], -1)
    in_camera = torch.linalg.solve(view.K, centres.T).T * z[:, None]
    covariances = (0.03 * z[:, None]) ** 2 * torch.tensor([1.0, 0, 0, 1, 0, 1])
    return Splats(in_camera - view.T_camera_world[:3, 3], covariances, torch.full((6,), 0.3), torch.arange(6))


def removed(hook: Prune, prior: DepthPrior) -> set[str]:
    """Who goes after one more evaluation of the cast."""
    view = make_views()[0]
    edit = hook.edit(context(cast(view), [view], prior))
    return set() if edit is None else {name for name, gone in zip(CAST, edit.remove.tolist(), strict=True) if gone}


def test_what_floats_in_free_space_goes_after_patience_and_a_surface_never() -> None:
    hook = Prune(PruneConfig(patience=3, light=1))
    assert [removed(hook, bands()) for _ in range(5)] == [set(), set(), FLOATING, FLOATING, FLOATING]


def test_without_the_term_only_the_papers_evidence_counts() -> None:
    hook = Prune(PruneConfig(patience=3, free_space=False, light=1))
    assert [removed(hook, bands()) for _ in range(4)] == [set(), set(), {"before the surface"}, {"before the surface"}]
    with_term = Prune(PruneConfig(patience=1, light=1))
    assert removed(with_term, bands()._replace(sigma=None)) == {"before the surface"}


def opaque(view: View) -> Splats:
    """The cast, too opaque for the paper's score."""
    return cast(view)._replace(opacities=torch.full((6,), 0.95))


def test_what_is_opaque_in_free_space_goes_once_scores_have_ended() -> None:
    """O_k is near 1, so S_k stays at a half however wrong its depth is: the paper's score never removes it."""
    view = make_views()[0]

    def gone(config: PruneConfig, splats: Splats) -> set[str]:
        hook, evaluation = Prune(config), context(splats, [view], bands())
        edits = [hook.edit(evaluation) for _ in range(3)]
        assert edits[:2] == [None, None], "patience"
        return set() if edits[2] is None else {name for name, out in zip(CAST, edits[2].remove, strict=True) if out}

    scores, floats = PruneConfig(patience=3, light=1), PruneConfig(patience=3, light=1, score_stop=1)
    assert gone(scores, opaque(view)) == set()
    assert gone(floats, opaque(view)) == FLOATING
    assert gone(replace(floats, free_space=False), opaque(view)) == set()
    assert gone(replace(floats, stop=5), cast(view)) == FLOATING, "faint ones as well"


def test_what_is_too_small_to_see_is_no_floater() -> None:
    """The same Gaussian, deep in free space, beside much light of others and beside less."""

    def first_floats(others: float) -> bool:
        error, weight, front = torch.tensor([[1.0, 0], [1.0, others], [0.6, 0]])
        return bool(module.floating(Sums(error, weight, *torch.ones(3, 2), front))[0])

    assert not first_floats(1e5)
    assert first_floats(1e4)


def test_the_sums_are_those_of_the_two_kinds_of_evidence() -> None:
    splats, views = scattered(1), [double(view) for view in make_views()[:2]]
    prior = bands()
    edge = PriorLoader(SimpleNamespace(prior=lambda *key: prior))(views[0]).near_edge(FREE_SIGMAS).double()
    error, total = torch.zeros(2, 40, dtype=torch.float64)
    for view in views:
        w, z = compositing_weights(splats, view), splats.means[:, 2]
        front = w * (1 - z / edge[..., None]).clamp(min=0)
        on = torch.where(prior.verified[..., None], w, 0)
        error += (on * (z - 3.0).abs() / 3.0 + front).sum((0, 1))
        total += (on + front).sum((0, 1))
    found = gather(context(splats, views, prior).evaluation, 40, True)
    torch.testing.assert_close(found[0], error, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(found[1], total, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("sight", [True, False])
def test_whose_centre_no_camera_sees_goes_at_once_however_much_of_its_rim_shows(sight: bool) -> None:
    """The first is seen by the left camera alone, which is not evaluated; the second, third by none; nothing is known
    of the last one's instant."""
    views, wall = make_views(), TinyStore().prior("", 0)
    means = torch.tensor([[-1.9, 0.0, 3.0], [0.0, 1.3, 3.0], [0.0, 0.0, -3.0]])
    here = Splats(means, 0.3**2 * torch.tensor([[1.0, 0, 0, 1, 0, 1]] * 3), torch.full((3,), 0.9), torch.arange(3))
    known = ViewSampler()
    for view in views:
        known.add(view)
    found = replace(context(here, views[2:3], wall), beside=known.beside, backbone=Fixed(here, not_now=1))
    edit = Prune(replace(EVERY_ONE, tau_p=1.0, sight=sight)).edit(found)
    assert (None if edit is None else edit.remove.tolist()) == ([False, True, True, False] if sight else None)
    pose = views[2].T_camera_world + torch.tensor([[0.0, 0, 0, 1], *3 * [[0] * 4]])
    known.add(replace(views[2], frame=7, T_camera_world=pose))  # other instants of a moving camera may see them
    assert Prune(replace(EVERY_ONE, tau_p=1.0, sight=sight)).edit(found) is None


@pytest.mark.parametrize(("step", "goes"), [(1, None), (2, [True, False])])
def test_in_the_last_evaluation_whose_fringe_alone_is_in_an_image_goes_too(step: int, goes: list[bool] | None) -> None:
    """Both centres are .05 within the image's left side, at -1.6; a tenth of the first one's size is .14."""
    view, known = make_views()[1], ViewSampler()
    known.add(view)
    variances = torch.tensor([0.8, 0.1])[:, None] ** 2 * torch.tensor([1.0, 0, 0, 1, 0, 1])
    here = Splats(torch.tensor([[-1.55, 0.0, 3.0]] * 2), variances, torch.full((2,), 0.9), torch.arange(2))
    assert view.sees(here.means).all()
    found = replace(context(here, [view], TinyStore().prior("", 0)), step=step, beside=known.beside)
    edit = Prune(replace(EVERY_ONE, tau_p=1.0, sight=True, every=1, stop=3)).edit(found)
    assert (None if edit is None else edit.remove.tolist()) == goes


def ring(*degrees: float, radius: float = 4.0, shift: float = 0.0) -> list[View]:
    """Cameras on a circle around (`shift`, 0, 0), which look at its middle and see half a unit around that."""
    K = torch.tensor([[100.0, 0, 16], [0, 100.0, 16], [0, 0, 1]])
    views = []
    for degree in degrees:
        angle = math.radians(degree)
        outwards = torch.tensor([math.cos(angle), math.sin(angle), 0.0], dtype=torch.float64)
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        rotation = torch.stack([torch.linalg.cross(up, outwards), -up, -outwards])
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = rotation
        pose[:3, 3] = -rotation @ (radius * outwards + torch.tensor([shift, 0.0, 0.0], dtype=torch.float64))
        views.append(View(f"at {degree:g}", 0, 0.0, pose.float(), K, 32, 32))
    return views


def around(*places: tuple[float, float]) -> Tensor:
    """Points at some degrees and distances from the origin."""
    return torch.tensor([[r * math.cos(math.radians(a)), r * math.sin(math.radians(a)), 0.0] for a, r in places])


def test_a_camera_could_stand_as_far_beside_another_as_the_next_one_does() -> None:
    cameras = ring(0, 40, 140)
    where = around((0, 3), (0, 5), (-39, 3), (-41, 3), (70, 3), (90, 3), (239, 3), (241, 3), (200, 4.1))
    expected = [True, False, True, False, True, True, True, False, False]
    assert module.before_cameras(where, cameras).tolist() == expected
    parallel = [replace(cameras[0], T_camera_world=shifted(cameras[0], x)) for x in (0.0, 0.5, 1.0)]
    assert not module.before_cameras(where, parallel).any()  # which look at no one place
    assert not module.before_cameras(where, ring(0, 40, 140, radius=-4)).any()  # which look away from it


def shifted(view: View, across: float) -> Tensor:
    pose = view.T_camera_world.clone()
    pose[0, 3] += across
    return pose


@given(st.floats(-3, 4), st.floats(-1e3, 1e3), st.integers(0, 2**31))
def test_where_a_camera_could_stand_has_no_units_and_no_origin(power: float, shift: float, seed: int) -> None:
    scale, g = 10**power, torch.Generator().manual_seed(seed)
    points = torch.randn(200, 3, generator=g, dtype=torch.float64) * 3
    here = module.before_cameras(points, ring(0, 50, 110))
    away = ring(0, 50, 110, radius=4 * scale, shift=shift * scale)
    there = module.before_cameras(points * scale + torch.tensor([shift * scale, 0, 0]), away)
    assert (here != there).sum() <= 2  # poses are float32


def test_what_one_camera_alone_sees_goes_at_the_end_and_what_two_see_or_hangs_behind_a_camera_stays() -> None:
    """Before the camera at 120 degrees; before that at 60, where all see it; behind the one that sees it."""
    cameras, known = ring(0, 60, 120), ViewSampler()
    for view in cameras:
        known.add(view)
    means = around((120, 2.0), (60, 0.3), (300, 4.5))
    here = Splats(means, 0.1**2 * torch.tensor([[1.0, 0, 0, 1, 0, 1]] * 3), torch.full((3,), 0.9), torch.arange(3))
    assert torch.stack([view.sees(means) for view in cameras]).sum(0).tolist() == [1, 3, 1]
    found = replace(context(here, cameras, TinyStore().prior("", 0)), beside=known.beside, instants=known.instants)
    hook = Prune(replace(EVERY_ONE, tau_p=1.0, alone=1))
    edit = hook.edit(found)
    assert edit is not None
    assert edit.remove is not None
    assert edit.remove.tolist() == [True, False, False]
    assert hook.edit(replace(found, step=2, sample=tuple)) is None
    for few in (cameras[1:], [*cameras, replace(cameras[0], frame=1, T_camera_world=cameras[1].T_camera_world)]):
        sampler = ViewSampler()
        for view in few:
            sampler.add(view)  # two cameras, or one that moves: nothing is said
        given = replace(found, beside=sampler.beside, instants=sampler.instants, sample=partial(tuple, few))
        assert hook.edit(given) is None


def test_who_sees_a_gaussian_is_judged_where_it_is_most_opaque() -> None:
    cameras = ring(0, 60, 120)
    instants = [replace(cameras[0], frame=frame, time=float(frame)) for frame in range(2)]

    class Moving(Fixed):
        def slice_at(self, view: View) -> Splats:
            one, all_ = around((120, 2.0)), torch.zeros(1, 3)
            order, fades = ([one, all_], [0.9, 0.2]) if view.time == 0 else ([all_, one], [0.3, 0.8])
            return Splats(torch.cat(order), torch.zeros(2, 6), torch.tensor(fades), torch.arange(2))

    model = Moving(Splats(torch.zeros(2, 3), torch.zeros(2, 6), torch.ones(2), torch.arange(2)), not_now=1)
    assert module.alone_before_cameras(model, cameras, instants).tolist() == [True, True, False]
    assert module.alone_before_cameras(model, cameras, instants[:1]).tolist() == [True, False, False]
    later = [replace(cameras[0], frame=frame, time=1.0) for frame in range(2, 4)]
    assert module.alone_before_cameras(model, cameras, instants + later).tolist() == [False, True, False]  # it is short


def test_it_comes_once_shortly_before_the_end_whether_or_not_pruning_has_retired() -> None:
    for iterations in (1, 40, 1000, 30_000):
        chosen = PruneConfig.for_iterations(iterations)
        assert chosen.alone is not None
        assert chosen.due(chosen.alone)
        assert 1 <= chosen.alone <= iterations
        assert chosen.stop is not None
        assert not any(chosen.due(step) for step in range(max(chosen.stop, 1), iterations + 1) if step != chosen.alone)
    calls: list[int] = []
    trainer = make_trainer(replace(CONFIG, prune=PruneConfig(start=1, every=1, stop=9, alone=11), retire_after=1), 12)
    prune = trainer.d2.hooks["prune"]
    edit = prune.edit
    prune.edit = lambda found: calls.append(found.step) or edit(found)
    trainer.d2.retired["prune"] = 0
    trainer.run()
    assert calls == [11]


def test_what_no_view_shows_by_a_twentieth_of_a_pixel_is_faint_and_what_none_shows_is_not_judged() -> None:
    largest = torch.tensor([0.0, 1e-6, 0.049, 0.051, 0.9])
    sums = Sums(*torch.ones(4, 5), largest, torch.zeros(5))
    assert module.faint(sums).tolist() == [False, True, True, False, False]
    here = scattered(0)
    found = context(here, make_views()[:3], TinyStore().prior("", 0))
    shown = torch.stack([survey.max_weight for _, _, _, survey in found.evaluation])
    assert gather(found.evaluation, 40, True).largest.tolist() == shown.amax(0).tolist()


def test_the_faintest_go_first_and_the_rest_waits() -> None:
    weight = torch.tensor([5.0, 1.0, 3.0, 0.5, 90.5])
    asked = torch.tensor([True, True, True, True, False])
    assert within_light(asked, weight, 0.05).tolist() == [False, True, True, True, False]
    assert within_light(asked, weight, 0.02).tolist() == [False, True, False, True, False]
    assert within_light(asked, weight, 1.0) is asked


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


CONFIG = D2Config(densify=DensifyConfig(start=1, every=1), prune=PruneConfig(start=1, every=1), retire_after=0)


def hooks_that_remove(masks: dict[str, torch.Tensor], **settings: float) -> tuple[D2Hooks, torch.Tensor]:
    """Hooks that ask for these rows to go, and the positions before."""
    model = make_model(count=40)
    d2 = D2Hooks(replace(CONFIG, **settings), make_adapter(model), TinyStore())
    for name, mask in masks.items():
        d2.hooks[name].edit = lambda context, mask=mask: Edit(remove=mask)
    return d2, model.gaussians["positions"].detach().clone()


@pytest.mark.parametrize(
    ("settings", "gone", "kept"), [({}, 36, slice(9, None, 10)), ({"remove_at_most": 0.5}, 20, slice(1, None, 2))]
)
def test_whatever_is_asked_for_some_stay_spread_over_the_rows_and_it_is_said(settings, gone, kept, caplog) -> None:
    d2, before = hooks_that_remove({"prune": torch.ones(40, dtype=torch.bool)}, **settings)
    with caplog.at_level(logging.WARNING):
        assert d2.step(1).removed == gone
    assert f"would remove 40 of 40 Gaussians, and at most {gone} go in one step (remove_at_most)" in caplog.text
    assert torch.equal(d2.backbone.model.gaussians["positions"], before[kept])


def test_hooks_together_stay_below_it() -> None:
    rows = torch.arange(40)
    d2, _ = hooks_that_remove({"densify": rows < 15, "prune": rows >= 30}, remove_at_most=0.25)
    assert d2.step(1).removed == 10
    counts = {trace.hook: trace.count for trace in d2.trace if trace.action == "remove"}
    assert counts == {"densify": 6, "prune": 4}


def test_what_is_no_more_than_that_goes_as_it_was_asked_for() -> None:
    rows = torch.arange(40)
    for share, asked in ((0.5, rows % 3 == 0), (1.0, rows >= 0)):
        d2, before = hooks_that_remove({"prune": asked}, remove_at_most=share)
        assert d2.step(1).removed == asked.sum()
        assert torch.equal(d2.backbone.model.gaussians["positions"], before[~asked])
