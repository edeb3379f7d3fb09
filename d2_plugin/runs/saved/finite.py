"""A model that diverged is not trained on, not saved and not scored."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from d2_plugin.errors import D2Error

OnStep = Callable[[int, float], None]
"""Called with the number of a training step and its loss."""
Watch = Callable[[Any], OnStep]
"""From a trainer to what is called after each of its steps."""


class Diverged(D2Error):
    """The loss or a parameter is no finite number."""


def parameters_of(model: Any) -> Iterator[tuple[str, Tensor]]:
    """The named tensors that a model trains: of its Gaussians and of each network or background that it holds."""
    for owner, part in vars(model).items():
        found = getattr(part, "parameters", None)
        if isinstance(found, dict):
            yield from found.items()
        elif isinstance(part, torch.nn.Module):
            yield from ((f"{owner}.{name}", value) for name, value in part.named_parameters())
        elif hasattr(part, "__dict__"):
            own = vars(part).items()
            yield from ((f"{owner}.{name}", value) for name, value in own if isinstance(value, torch.nn.Parameter))


@torch.no_grad()
def all_finite(model: Any, loss: Tensor | None = None) -> bool:
    """Whether no parameter is NaN or infinite, nor the loss; asks the device once.

    A sum is finite only where all its terms are, and reads the tensor once.
    """
    values = [value.sum() for _, value in parameters_of(model)] + ([] if loss is None else [loss])
    if not values or bool(torch.stack([value.double().reshape(()) for value in values]).isfinite().all()):
        return True
    return not what_diverged(model, loss)  # the sum of finite numbers may overflow


@torch.no_grad()
def what_diverged(model: Any, loss: Tensor | None = None) -> str:
    """Which parameter is not finite, and how much of it; else that the loss is not; nothing where all are."""
    for name, value in parameters_of(model):
        bad = 1 - value.isfinite().double().mean().item() if value.numel() else 0.0
        if bad > 0:
            return f"{bad:.2%} of {name} is NaN or infinite"
    return "" if loss is None or bool(loss.isfinite()) else f"the loss is {float(loss):g}"


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
        def told(step: int, loss: float) -> None:
            total = getattr(trainer, "loss", None)
            if not all_finite(trainer.model, torch.as_tensor(loss) if total is None else total):
                error = diverged(step, loss)
                if error is not None:
                    raise error
            on_step(step, loss)

        return told

    try:
        yield watch
    except Diverged:
        raise
    except (RuntimeError, ValueError, ArithmeticError, IndexError):
        error = diverged(trainer.step)
        if error is not None:
            raise error from None
        raise
