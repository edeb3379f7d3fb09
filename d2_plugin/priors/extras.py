"""Optional packages of the priors, imported when first needed; the error for a missing one names what to install."""

from __future__ import annotations

from types import ModuleType

from d2_plugin.recordings.images import opencv as cv2_for


def opencv(purpose: str) -> ModuleType:
    """The `cv2` module for `purpose` (see `images.opencv`), as the extra `stereo` brings it."""
    return cv2_for(purpose, extra="stereo")
