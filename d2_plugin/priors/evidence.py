"""What the other cameras of an instant show of a mono-only depth; an addition to the paper.

A mono-only pixel is a point in space that other cameras may see.

- Where the pixel's ray meets a surface that another camera measured by stereo, near the monocular depth, the two
  sources confirm each other and the surface is taken. The pixel is agreed and not verified: it has no stereo of its
  own, and without the network it has no depth.
- Where two cameras' monocular depths meet and the colours are alike, each confirms the other as far as their errors
  are independent, which is not far: both were bent by anchors of one scene, and one network errs alike in both. So
  agreement takes nearly half off sigma and no more; where sigma is infinite, as in a sky, it stays so.
- Where others see the place and none of them has a surface there, one of them is wrong: sigma grows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from d2_plugin.priors.cross_view.kernel import View, compare_views
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.recording import Camera
from d2_plugin.store.maps import FusedPrior

AGREED = 0.57
"""Factor of sigma where another camera's monocular depth agrees and the colours are alike. What a heavy tail added to
sigma falls away there: agreement is evidence that this is not one of the things that the map misses."""
AT_BEST = 0.01
"""What agreement cannot go below, in quadrature: errors that the maps share do not show in their difference."""
ALONE = 1.05
"""Factor of sigma where others see the place and none agrees."""


def with_evidence(
    priors: Mapping[str, FusedPrior],
    cameras: Mapping[str, Camera],
    tolerance: float,
    tails: Mapping[str, float] | None = None,
    at_best: float = AT_BEST,
) -> dict[str, FusedPrior]:
    """The priors of one instant, each mono-only pixel compared with the other cameras.

    Args:
        priors: D* of synchronized views, by camera.
        cameras: their calibrations.
        tolerance: largest relative difference at which two monocular depths agree.
        at_best: what agreement of two maps cannot go below, in quadrature.
        tails: by camera, how many times sigma is enlarged for a heavy tail (`Skill.tail`); 1 where that is unknown.
    """
    views = {name: view_of(prior) for name, prior in priors.items()}
    factors = {name: AGREED / np.fmax((tails or {}).get(name, 1.0), 1.0) for name in priors}
    changed = compare_views(views, cameras, factors, {"tolerance": tolerance, "at_best": at_best, "alone": ALONE})
    return {
        name: replace(prior, labels=changed[name][0], depth=changed[name][1], sigma=changed[name][2])
        for name, prior in priors.items()
    }


def view_of(prior: FusedPrior) -> View:
    """The maps of a prior that other views are compared with."""
    labels, depth, sigma = (np.ascontiguousarray(map_) for map_ in (prior.labels, prior.depth, prior.sigma))
    with np.errstate(divide="ignore"):
        log = np.log(np.fmax(depth, 0))
    colors = None if prior.colors is None else opencv("the evidence of other cameras").blur(prior.colors, (3, 3))
    return View(labels, depth, log, sigma, colors)
