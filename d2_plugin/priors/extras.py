"""Optional packages of the priors, imported when first needed; the error for a missing one says what to install."""

from __future__ import annotations

from types import ModuleType

from d2_plugin.errors import missing_extra


def opencv(purpose: str) -> ModuleType:
    """The `cv2` module; `purpose` completes the sentence "<purpose> needs OpenCV".

    Raises:
        MissingExtra: where it is not installed.
    """
    try:
        import cv2
    except ImportError:
        raise missing_extra("OpenCV", "stereo", purpose) from None
    return cv2
