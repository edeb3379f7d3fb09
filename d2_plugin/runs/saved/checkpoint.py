"""checkpoint.pt: what `torch.save` writes, with the version of its form; zip's own checksums guard every tensor."""

from __future__ import annotations

import io
import pickle
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from d2_plugin.durable import Damaged, OtherFormat, archive_problem, write
from d2_plugin.errors import D2Error

FORMAT = 1
"""Raise it when a checkpoint gets another form."""

MISFITS = (RuntimeError, KeyError, TypeError, AttributeError, IndexError, ValueError, EOFError, pickle.UnpicklingError)
"""What torch and the models raise for a state that is not theirs."""

_REMEDY = "remove the file to train from the start, or put a copy of it back"


def save_checkpoint(path: Path, state: Mapping[str, Any]) -> None:
    """Write a state of plain values and tensors; a kill or a full disk leaves the checkpoint before it."""
    content = io.BytesIO()  # torch ends the process where a file that it writes itself cannot be written
    torch.save({**state, "format": FORMAT}, content)
    write(path, content.getbuffer())


def load_checkpoint(path: Path, device: str) -> dict[str, Any] | None:
    """The state that was saved, or None where nothing was.

    Raises:
        D2Error: it is damaged, or that of another version.
    """
    if not path.exists():
        return None
    problem = archive_problem(path)
    if problem:
        raise Damaged(f"the checkpoint {path} is damaged ({problem}): {_REMEDY}")
    with fitting(path):
        state = torch.load(path, map_location=device, weights_only=True)
    form = state.get("format") if isinstance(state, dict) else None
    if form != FORMAT:
        raise OtherFormat(
            f"the checkpoint {path} has format {form} but this version reads format {FORMAT}: continue it with the "
            "d2-4dgs that wrote it, or remove the file to train from the start"
        )
    return state


@contextmanager
def fitting(path: Path) -> Iterator[None]:
    """Within it, a state that does not fit is one sentence."""
    try:
        yield
    except D2Error:
        raise
    except MISFITS as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise Damaged(f"the checkpoint {path} is not one of this run ({reason}): {_REMEDY}") from None
