"""tho-kn/cem-4dgs: Ex4DGS whose key-framed motions are shared by kinematic parents, which are never drawn themselves.

    d2 = D2Hooks.attach("d2.toml", "cem4dgs", gaussians, near=dataset.near, far=dataset.far,
                        iterations=opt.iterations)       # train.py:65 (restore)
    loss = loss + d2.loss(iteration, viewpoint_cam)      # before :173
    d2.step(iteration)                                   # after prune_nan_points

The contract's rows are the splats, one table; the table of motions has no row of its own in it.
"""

from __future__ import annotations

import torch

from d2_plugin.protocol import Points

from ..ex4dgs import Ex4DGSAdapter
from ..inria import InriaAdapter

ROOT = -1
"""The parent of a splat that has none, in `_parent`."""


class CEM4DGSAdapter(Ex4DGSAdapter):
    """A `VGaussianModel` as a `d2_plugin.protocol.Backbone`; arguments as `Ex4DGSAdapter` has them.

    A splat of level 0 drifts by `_xyz_disp`; one of level 1 hangs on a motion, its parent, which moves and turns it,
    and lives in the span that its own `_opacity_duration_*` say. Motions are rows of `_xyz_motion` beyond the splats in
    `_parent` and `_level`; nothing of them is drawn, so D2 neither surveys nor removes them.

    Its `get_..._at_t` give the splats of an instant in the order of that table, so the slice is Ex4DGS's.

    Inserted Gaussians are splats of level 0 without drift; the repository hangs those that do not fit on motions, and
    deletes motions without children itself.
    """

    __len__ = InriaAdapter.__len__
    remove = InriaAdapter.remove
    _harmonics = InriaAdapter._harmonics
    _before_append = InriaAdapter._before_append
    _before_prune = InriaAdapter._before_prune  # type: ignore[assignment]  # one mask for one table

    def _append(self, points: Points) -> None:
        """As splats of level 0, whose parents and levels its callers lengthen by hand: splats come before motions."""
        model, rows, count = self.gaussians, self._raw_rows(points), len(points.positions)
        span = points.positions.new_zeros(count, 2, 1)
        span[:, 1] = 1.0
        static = len(model._xyz)
        parent, level = model._parent, model._level
        # every motion moves `count` places up in the joint table, and with it the numbers that point at it
        moved = torch.where(parent >= static, parent + count, parent)
        model._parent = torch.cat([moved[:static], moved.new_full((count, 1), ROOT), moved[static:]])
        model._level = torch.cat([level[:static], level.new_zeros(count, 1), level[static:]])
        drift = torch.zeros_like(rows.xyz)
        model.densification_postfix_onlystatic(*rows, drift, span, torch.ones_like(span))

    def _sizes(self) -> tuple[int, int]:
        return len(self.gaussians._xyz), 0
