"""The bench of official trainers makes images no smaller than a trainer's own report can be measured on."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.trainers import prepare
from benchmarks.trainers.trials import TRIALS
from d2_plugin.errors import D2Error


@pytest.mark.parametrize(
    ("height", "asked", "fudan", "other"),
    [(360, 2, 2, 2), (320, 2, 1, 2), (180, 2, 1, 2), (1014, 8, 6, 8), (161, 1, 1, 1)],
)
def test_fudans_ms_ssim_decides(
    height: int, asked: int, fudan: int, other: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = SimpleNamespace(cameras={"00": SimpleNamespace(width=2 * height, height=height)})
    monkeypatch.setattr(prepare, "open_recording", lambda folder: recording)
    assert prepare.fitting_downscale(Path("made"), TRIALS["fudan"], asked) == fudan
    assert prepare.fitting_downscale(Path("made"), TRIALS["4c4d"], asked) == other


def test_what_is_too_small_at_any_factor_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = SimpleNamespace(cameras={"00": SimpleNamespace(width=320, height=160)})
    monkeypatch.setattr(prepare, "open_recording", lambda folder: recording)
    with pytest.raises(D2Error, match=r"160 pixels along a side, and the report of 4d-gaussian-splatting needs 161"):
        prepare.fitting_downscale(Path("made"), TRIALS["fudan"], 2)
