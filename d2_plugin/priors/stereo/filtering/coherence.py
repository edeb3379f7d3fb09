"""Surface coherence: does a depth lie on the same surface as the depths around it?

A wrong match is seldom wrong in the same way as its neighbours, while a right one shares a tangent plane with them.
The test needs nothing but the depth map, so it judges every matcher alike.
"""

from __future__ import annotations

import numpy as np

from d2_plugin.priors.extras import opencv
from d2_plugin.priors.stereo.filtering import kernel
from d2_plugin.priors.stereo.filtering.confirm import RELATIVE_DEPTH

RADIUS = 9
"""Half the side of the square window, pixels, a multiple of `STRIDE`."""
CONTRAST = 0.05
"""Standard deviation of the weight over grey values, in 0..1: neighbours that differ by more have little say."""
STRIDE = 3  # pixels between the neighbours that are compared
SLOPE_REACH = 2  # pixels between the ends of a difference: shorter ones amplify noise, longer ones cross edges


def surface_coherence(gray: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Share of a pixel's neighbours that lie on its tangent plane, weighted by similarity of grey value.

    A plane in space is linear in inverse depth over the image, so the tangent is the gradient of inverse depth, taken
    as a median of 5x5 that a few wrong neighbours cannot turn. A neighbour agrees within `RELATIVE_DEPTH` of inverse
    depth; those without depth count as disagreeing.

    Args:
        gray: uint8 [H, W].
        depth: planar z float32 [H, W], 0 where there is none.

    Returns:
        float32 [H, W] in 0..1; 0 where there is no depth.
    """
    cv2 = opencv("the filter of geometric depth")
    inverse, across, down = kernel.slopes(np.ascontiguousarray(depth, np.float32), SLOPE_REACH)
    slopes = cv2.medianBlur(across, 5), cv2.medianBlur(down, 5)
    weights = np.append(np.exp(-0.5 * (np.arange(256) / 255 / CONTRAST) ** 2), 0).astype(np.float32)
    return kernel.coherence(np.ascontiguousarray(gray), inverse, slopes, weights, RADIUS, STRIDE, RELATIVE_DEPTH)
