"""What a run keeps in its folder, whose folder it is, and that no model is kept that diverged.

run.json and metrics.json are tables with a checksum. checkpoint.pt is what `torch.save` writes, with the version of its
form and a checksum of all its bytes, which are compared before torch sees them.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from d2_plugin import durable
from d2_plugin.errors import D2Error
from d2_plugin.gaussians.trained import trained_tensors
from d2_plugin.hooks import finite
from d2_plugin.hooks.finite import Diverged
from d2_plugin.locks import only_writer
from d2_plugin.reading import parsing
from d2_plugin.runs.settings import PATHS, RunSettings
from d2_plugin.values import shown

RUN = durable.Kind("table of settings", 1, "run `d2 train` with another --output, or remove that folder")
"""run.json."""

METRICS = durable.Kind("table of scores", 1, "run `d2 eval` on that folder")
"""metrics.json."""


def read_run(folder: Path) -> dict[str, Any]:
    """The run.json of a run folder.

    Raises:
        D2Error: there is none, it is damaged, or that of another version.
    """
    try:
        return durable.read_table(folder / "run.json", RUN)
    except FileNotFoundError:
        raise D2Error(f"{folder} holds no run: expected run.json; give the --output folder of `d2 train`") from None


def read_metrics(folder: Path) -> dict[str, Any]:
    """The metrics.json of a run folder.

    Raises:
        D2Error: there is none, it is damaged, or that of another version.
    """
    try:
        return durable.read_table(folder / "metrics.json", METRICS)
    except FileNotFoundError:
        raise D2Error(f"{folder} has no metrics.json: finish `d2 train` there, or run `d2 eval`") from None


def claim(folder: Path, identity: Mapping[str, Any]) -> None:
    """Take the folder, or find this very run in it; anything else is refused and nothing is written."""
    durable.refuse_inside_images(folder)
    if (folder / "run.json").exists():
        _refuse_another(folder, identity)
        return
    if folder.is_dir() and not all(durable.is_leftover(inside) for inside in folder.iterdir()):
        raise D2Error(f"{folder} is not empty and holds no run of ours: give another --output")
    with only_writer(durable.make_folder(folder)):
        if (folder / "run.json").exists():  # somebody was quicker
            _refuse_another(folder, identity)
        else:
            durable.write_table(folder / "run.json", dict(identity), RUN)


def follow_moved(folder: Path, settings: RunSettings) -> None:
    """Let run.json, where there is one, say where files of the same name lie now in place of those that are gone."""
    if not (folder / "run.json").exists():
        return
    table, now = read_run(folder), settings.as_table()
    gone = [name for name in PATHS if table.get(name) and now[name] and not Path(table[name]).exists()]
    moved = {name: now[name] for name in gone if Path(now[name]).name == Path(table[name]).name}
    if moved:
        with only_writer(folder):
            durable.write_table(folder / "run.json", table | moved, RUN)


def _refuse_another(folder: Path, identity: Mapping[str, Any]) -> None:
    table = read_run(folder)
    guidance = {"guidance": table.pop("guidance")} if "guidance" in table else {}
    kept = RunSettings.from_table(table, str(folder / "run.json")).as_table() | guidance
    names = (identity.keys() | kept.keys()) - {"accept_empty_prior"}  # it changes nothing but whether there is a run
    changed = sorted(k for k in names if identity.get(k) != kept.get(k))
    if changed:
        raise D2Error(
            f"{folder} holds another run, made with other settings of {', '.join(changed)}: "
            "give another --output, or remove that folder"
        )


CHECKPOINT_FORMAT = 1
"""Raise it when a checkpoint gets another form."""

REMEDY = "remove the file to train from the start, or put a copy of it back"


def save_checkpoint(path: Path, state: Mapping[str, Any]) -> None:
    """Write a state of plain values and tensors; a kill or a full disk leaves the checkpoint before it."""
    content = io.BytesIO()  # torch ends the process where a file that it writes itself cannot be written
    torch.save({**state, "format": CHECKPOINT_FORMAT}, content)
    durable.write_archive(path, content)


def load_checkpoint(path: Path, device: str) -> dict[str, Any] | None:
    """The state that was saved, or None where nothing was.

    Raises:
        D2Error: it is damaged, or that of another version.
    """
    if not path.exists():
        return None
    with durable.opened_archive(path, "checkpoint", REMEDY) as file, parsing(f"the checkpoint {path}", REMEDY):
        state = torch.load(file, map_location=device, weights_only=True)
    form = state.get("format") if isinstance(state, dict) else None
    if form != CHECKPOINT_FORMAT:
        raise durable.OtherFormat(
            f"the checkpoint {path} has format {shown(form)} but this version reads format {CHECKPOINT_FORMAT}: "
            "continue it with the d2-4dgs that wrote it, or remove the file to train from the start"
        )
    return state


OnStep = Callable[[int, float], None]
"""Called with the number of a training step and its loss."""
Watch = Callable[[Any], OnStep]
"""From a trainer to what is called after each of its steps."""


def what_diverged(model: Any, loss: Tensor | None = None) -> str:
    """Which parameter of the model is not finite, else that the loss is not; nothing where all are."""
    return finite.what_diverged(dict(trained_tensors(model)), loss)


@contextmanager
def watched(trainer: Any, checkpoint: Path) -> Iterator[OnStep]:
    """Within it, training stops at the step at which a loss or a parameter is no finite number any more.

    Gives what checks a step: call it first in the trainer's `on_step`. What a step does with such numbers before it
    ends, errors included, is reported as what it is.

    Raises:
        Diverged: with the step, the parameter, and the checkpoint before it.
    """
    first = trainer.step

    def check(step: int, loss: float = 0.0) -> None:
        total = getattr(trainer, "loss", None)
        wrong = what_diverged(trainer.model, torch.as_tensor(loss) if total is None else total)
        if wrong:
            kept = f"the last good checkpoint is {checkpoint}, step {first}" if first else "there is no checkpoint yet"
            advice = "lower the weight or the learning rate that was raised last"
            raise Diverged(f"training diverged at step {step} ({wrong}): {kept}; {advice}")

    try:
        yield check
    except (RuntimeError, ValueError, ArithmeticError, IndexError):
        try:
            check(trainer.step)
        except Diverged as error:
            raise error from None
        raise
