"""A model that diverged is not trained on, not saved and not scored."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from d2_plugin.gaussians.trained import trained_tensors
from d2_plugin.hooks import finite
from d2_plugin.hooks.finite import Diverged

__all__ = ["Diverged", "OnStep", "Watch", "all_finite", "watched", "what_diverged"]

OnStep = Callable[[int, float], None]
"""Called with the number of a training step and its loss."""
Watch = Callable[[Any], OnStep]
"""From a trainer to what is called after each of its steps."""


def all_finite(model: Any, loss: Tensor | None = None) -> bool:
    """Whether no parameter of the model is NaN or infinite, nor the loss."""
    return finite.all_finite(dict(trained_tensors(model)), loss)


def what_diverged(model: Any, loss: Tensor | None = None) -> str:
    """Which parameter of the model is not finite, else that the loss is not; nothing where all are."""
    return finite.what_diverged(dict(trained_tensors(model)), loss)


@contextmanager
def watched(trainer: Any, checkpoint: Path) -> Iterator[Callable[[OnStep], OnStep]]:
    """Within it, training stops at the step at which a loss or a parameter is no finite number any more.

    Gives what wraps the trainer's `on_step`. What a step does with such numbers before it ends, errors included, is
    reported as what it is.

    Raises:
        Diverged: with the step, the parameter, and the checkpoint before it.
    """
    first = trainer.step

    def diverged(step: int, loss: float = 0.0) -> Diverged | None:
        total = getattr(trainer, "loss", None)
        wrong = what_diverged(trainer.model, torch.as_tensor(loss) if total is None else total)
        kept = f"the last good checkpoint is {checkpoint}, step {first}" if first else "there is no checkpoint yet"
        advice = "lower the weight or the learning rate that was raised last"
        return Diverged(f"training diverged at step {step} ({wrong}): {kept}; {advice}") if wrong else None

    def watch(on_step: OnStep) -> OnStep:
        def checked_step(step: int, loss: float) -> None:
            total = getattr(trainer, "loss", None)
            if not all_finite(trainer.model, torch.as_tensor(loss) if total is None else total):
                error = diverged(step, loss)
                if error is not None:
                    raise error
            on_step(step, loss)

        return checked_step

    try:
        yield watch
    except (RuntimeError, ValueError, ArithmeticError, IndexError):
        error = diverged(trainer.step)
        if error is not None:
            raise error from None
        raise
