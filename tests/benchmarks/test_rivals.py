"""The rivals' losses are the published ones: golden values from numpy, gradients by differences, stiff maps."""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from at_once import measured_at_once
from numpy.lib.stride_tricks import sliding_window_view
from tiny import BACKBONES, TinyStore, make_adapter, make_model, make_views
from torch import Tensor

from benchmarks.rivals.patch_norm import PatchNorm, PatchNormConfig, patch_norm_loss
from benchmarks.rivals.pearson import pearson_depth_loss
from benchmarks.rivals.scale_shift import scale_shift_loss
from benchmarks.rivals.sparse_points import Seen, sparse_point_loss
from benchmarks.rivals.sweep import best_change
from benchmarks.rivals.table import RIVAL_PRESETS, RIVALS
from d2_plugin import D2Config, D2Hooks
from d2_plugin.errors import D2Error
from d2_plugin.hooks import Context, Hook, HookConfig
from d2_plugin.hooks.prior import PriorLoader
from d2_plugin.runs.ablation.ablate import ablate
from d2_plugin.runs.ablation.presets import PRESETS, rows_named
from d2_plugin.runs.rows import read_rows
from d2_plugin.runs.settings import RunSettings

RNG = np.random.default_rng(7)
DEPTH = RNG.uniform(2, 9, (23, 31))
MONO = 3.1 / DEPTH + 0.4 + RNG.normal(0, 0.05, DEPTH.shape)
MASK = RNG.uniform(size=DEPTH.shape) < 0.8
FLAT = np.full(DEPTH.shape, 4.0)
NOTHING = np.zeros_like(MASK)
ONE = NOTHING.copy()
ONE[3, 4] = True


def tensor(values: np.ndarray, grad: bool = False) -> Tensor:
    return torch.tensor(values, dtype=torch.float64 if values.dtype != bool else torch.bool, requires_grad=grad)


PIXELS = np.array([[0.5, 0.5], [3.25, 7.5], [30.5, 22.5], [12.0, 3.0]])
SEEN = Seen(tensor(PIXELS), tensor(np.array([4.0, 2.5, 7.0, 3.0])))


def bilinear(values: np.ndarray) -> np.ndarray:
    """At PIXELS, by hand, with pixel centres at i + 0.5."""
    found = []
    for column, row in PIXELS - 0.5:
        j, i = min(int(column), values.shape[1] - 2), min(int(row), values.shape[0] - 2)
        u, v = column - j, row - i
        found.append((np.outer([1 - v, v], [1 - u, u]) * values[i : i + 2, j : j + 2]).sum())
    return np.array(found)


def normalised(values: np.ndarray, whole: bool, side: int = 5) -> np.ndarray:
    """Patches [P, 25] of a window that slides by its own size, centred and divided by a deviation."""
    patches = sliding_window_view(values, (side, side))[::side, ::side].reshape(-1, side**2)
    deviation = values.std(ddof=1) if whole else patches.std(1, ddof=1, keepdims=True)
    return (patches - patches.mean(1, keepdims=True)) / (deviation + 0.01 * patches.std(ddof=1))


class TestGoldenValues:
    def test_pearson(self) -> None:
        scaled = (MONO - MONO.min()) / (MONO.max() - MONO.min()) * 2000
        candidates = [np.corrcoef(m.ravel(), DEPTH.ravel())[0, 1] for m in (-scaled, 1 / (scaled + 200))]
        found = pearson_depth_loss(tensor(DEPTH), tensor(MONO))
        assert found.item() == pytest.approx(1 - max(candidates), abs=1e-12)

    def test_scale_shift(self) -> None:
        x, y, m = 1 / DEPTH, MONO, MASK
        s, t = np.polyfit(x[m], y[m], 1)
        residual = np.where(m, s * x + t - y, 0)
        wanted = (residual**2).sum() / (2 * m.sum())
        for k in range(4):
            r, n = residual[:: 2**k, :: 2**k], m[:: 2**k, :: 2**k]
            differences = (np.abs(np.diff(r, axis=1)) * (n[:, 1:] & n[:, :-1])).sum()
            differences += (np.abs(np.diff(r, axis=0)) * (n[1:] & n[:-1])).sum()
            wanted += 0.5 * differences / n.sum()
        assert scale_shift_loss(tensor(x), tensor(y), tensor(m)).item() == pytest.approx(wanted, rel=1e-10)

    @pytest.mark.parametrize("whole", [True, False])
    @pytest.mark.parametrize("tolerance", [0.00025, 0.2])
    def test_patch_norm(self, whole: bool, tolerance: float) -> None:
        difference = normalised(DEPTH, whole) - normalised(-MONO, whole)
        wanted = (difference[np.abs(difference) > tolerance] ** 2).mean()
        found = patch_norm_loss(tensor(DEPTH), tensor(-MONO), 5, tolerance, whole)
        assert found.item() == pytest.approx(wanted, rel=1e-10)

    def test_sparse_points(self) -> None:
        wanted = 2.5 * np.abs(1 / bilinear(DEPTH) - 1 / SEEN[1].numpy()).mean()
        assert sparse_point_loss(tensor(DEPTH), SEEN, 2.5).item() == pytest.approx(wanted, rel=1e-12)


LOSSES: dict[str, tuple[Callable[[Tensor], Tensor], np.ndarray]] = {
    "pearson": (lambda d: pearson_depth_loss(d, tensor(MONO[:4, :5])), DEPTH[:4, :5]),
    "scale_shift": (
        lambda x: scale_shift_loss(x, tensor(MONO[:6, :7]), tensor(MASK[:6, :7]), scales=2),
        1 / DEPTH[:6, :7],
    ),
    "patch_norm": (lambda d: patch_norm_loss(d, tensor(-MONO[:10, :10]), 5, 1e-9, False), DEPTH[:10, :10]),
    "sparse_points": (lambda d: sparse_point_loss(d, SEEN, 1.0), DEPTH),
}


@pytest.mark.parametrize("name", LOSSES)
def test_gradients_are_those_of_the_loss(name: str) -> None:
    """That of scale_shift flows through its fit."""
    loss, at = LOSSES[name]
    torch.autograd.gradcheck(loss, tensor(at, True))


DEGENERATE: dict[str, tuple[Callable[[Tensor], Tensor], np.ndarray, float | None]] = {
    "pearson, flat render": (lambda d: pearson_depth_loss(d, tensor(MONO).to(d)), FLAT, 1),
    "pearson, flat map": (lambda d: pearson_depth_loss(d, tensor(FLAT).to(d)), DEPTH, 1),
    "pearson, one pixel": (lambda d: pearson_depth_loss(d, tensor(MONO[:1, :1]).to(d)), DEPTH[:1, :1], 1),
    "pearson, no map": (lambda d: pearson_depth_loss(d, tensor(DEPTH * np.nan).to(d)), DEPTH, 1),
    "scale_shift, no pixel": (lambda x: scale_shift_loss(x, tensor(MONO).to(x), tensor(NOTHING)), 1 / DEPTH, 0),
    "scale_shift, one pixel": (lambda x: scale_shift_loss(x, tensor(MONO).to(x), tensor(ONE)), 1 / DEPTH, None),
    "scale_shift, flat render": (lambda x: scale_shift_loss(x, tensor(MONO).to(x), tensor(MASK)), FLAT, None),
}
"""Where nothing can be told: the loss of what, at which render, and its value where that is known."""


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", DEGENERATE)
def test_where_nothing_can_be_told_there_is_no_gradient(name: str, dtype: torch.dtype) -> None:
    loss, at, value = DEGENERATE[name]
    d = tensor(at).to(dtype).requires_grad_()
    found = loss(d)
    found.backward()
    assert value is None or found.item() == pytest.approx(value, abs=1e-6)
    assert (d.grad == 0).all()


@pytest.mark.parametrize("backbone", BACKBONES)
@pytest.mark.parametrize(
    ("soft_start", "wanted"), [(10, {"positions"}), (0, {"positions", "opacity_logits"})], ids=["hard", "and soft"]
)
def test_hard_depth_moves_centres_and_soft_depth_fades_gaussians_and_nothing_else_learns(
    backbone: str, soft_start: int, wanted: set[str]
) -> None:
    """DNGaussian's code freezes all but positions for one term, and all but opacities for the other."""
    adapter = make_adapter(make_model(backbone=backbone))
    slope = SimpleNamespace(inverse_depth=lambda view: torch.linspace(1, 2, view.width).expand(view.height, -1))
    hook = PatchNorm(PatchNormConfig(soft_start=soft_start), slope)
    context = Context(5, adapter, make_views()[:1], PriorLoader(TinyStore()), torch.Generator().manual_seed(0))
    loss = hook.loss(context)
    loss.backward()
    trained = adapter.trained()
    assert {name for name, value in trained.items() if value.grad is not None and value.grad.any()} == wanted


def test_every_rival_trains_on_one_prior_and_says_its_name(saved_room: Callable[..., Path], tmp_path: Path) -> None:
    pytest.importorskip("pycolmap", reason="pycolmap is in the `stereo` extra")
    room = saved_room(cameras=2, held_out=1, frames=2, width=96, height=54)
    presets = rows_named(["backbone", *RIVALS, "full"], PRESETS | RIVAL_PRESETS)
    with measured_at_once():
        ablate(RunSettings(str(room), ("train0", "train1"), iterations=4), presets, ["yang4d"], [0], tmp_path, 1, "")
    rows = read_rows([tmp_path / "runs.jsonl"])
    assert {row["method"].removeprefix("yang4d ") for row in rows} == {"backbone", *RIVALS, "full"}
    assert [path.name for path in (tmp_path / "priors").iterdir() if path.is_dir()] == ["dual"]
    for name in RIVALS:
        metrics = json.loads((tmp_path / "yang4d" / name / "seed0" / "metrics.json").read_text())
        assert metrics["guidance"]["name"] == name
        assert metrics["cpu_seconds"]["train"] > 0


@pytest.mark.parametrize("name", RIVALS)
def test_the_best_of_a_rival_is_that_of_the_sweep(name: str) -> None:
    """No weight of a table is chosen by hand."""
    rows = read_rows([Path(__file__).parents[2] / "docs" / "results" / "rivals-sweep.jsonl"])
    assert str(RIVALS[name].best) == best_change(rows, name)


def test_a_hook_of_ones_own_does_not_take_the_name_of_one_of_d2s() -> None:
    with pytest.raises(D2Error, match="named 'prune'"):
        D2Hooks(D2Config(), make_adapter(make_model()), TinyStore(), {"prune": Hook(HookConfig())})
