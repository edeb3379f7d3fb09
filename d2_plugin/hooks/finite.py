"""Training stops where a parameter or the loss is not finite, in any trainer, checked now and then."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.protocol import Backbone, View, call_optional


class Diverged(D2Error):
    """The loss or a parameter is no finite number."""


@torch.no_grad()
def what_diverged(parameters: Mapping[str, Tensor], loss: Tensor | None = None) -> str:
    """Which parameter is not finite, and how much of it; else that the loss is not; nothing where all are.

    Asks the device once where all are: a sum is finite only where all its terms are, and reads the tensor once.
    """
    values = [value.sum() for value in parameters.values()] + ([] if loss is None else [loss])
    sums = [value.double().reshape(()).to(values[0].device) for value in values]
    if not sums or bool(torch.stack(sums).isfinite().all()):
        return ""
    for name, value in parameters.items():  # the sum of finite numbers may overflow
        bad = 1 - value.isfinite().double().mean().item() if value.numel() else 0.0
        if bad > 0:
            return f"{bad:.2%} of {name} is NaN or infinite"
    return "" if loss is None or bool(loss.isfinite()) else f"the loss is {float(loss):g}"


class FiniteCheck:
    """Checks a backbone every so many steps, before hooks edit it, and before its state is saved.

    A trainer's loss that is NaN makes parameters NaN in the same step, so that checking these is enough.
    """

    def __init__(self, backbone: Backbone, every: int) -> None:
        """`every`: steps from one check to the next; 0 never checks."""
        self.backbone, self.every = backbone, every
        self.step, self.saved = 0, 0
        """The last step, and the one at which the state was saved last; 0 for none."""
        self._loss: Tensor | None = None
        self._view: View | None = None

    def remember(self, loss: Tensor | float, views: Sequence[View]) -> None:
        """D2's share of the loss in this step, and what was trained on."""
        self._loss = loss.detach() if isinstance(loss, Tensor) else None
        self._view = views[-1] if views else self._view

    def check(self, step: int, now: bool) -> None:
        """Check where it is time to, or `now`.

        Raises:
            Diverged: with the step, the parameter, and the last step whose state was saved.
        """
        self.step = step
        if not self.every or not (now or step % self.every == 0):
            return
        wrong = what_diverged(self._parameters(), self._loss)
        if not wrong:
            return
        if wrong.startswith("the loss"):
            wrong = wrong.replace("the loss", "D2's loss")
        elif self._loss is not None and not bool(self._loss.isfinite()):
            wrong += ", and so is D2's loss"
        kept = f"the last state that was saved is of step {self.saved}" if self.saved else "no state was saved yet"
        raise Diverged(
            f"training diverged at step {step} or less than {self.every} steps before it ({wrong}): {kept}; lower the "
            "weight or the learning rate that was raised last"
        )

    def before_saving(self) -> None:
        """Refuse a state that training cannot continue from; remember the step of one that it can."""
        if self.step:
            self.check(self.step, now=True)
        self.saved = self.step

    def _parameters(self) -> Mapping[str, Tensor]:
        """The backbone's own, by their names; of one without `trained`, what it draws in the last view."""
        named: Mapping[str, Tensor] | None = call_optional(self.backbone, "trained")
        if named is not None:
            return named
        if self._view is None:
            return {}
        with torch.no_grad():
            splats = self.backbone.slice_at(self._view)
        return {"means": splats.means, "covariances": splats.covariances, "opacities": splats.opacities}
