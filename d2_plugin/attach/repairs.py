"""What newer libraries dropped and the repositories still use, restored in the memory of this process."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from typing import Any

import numpy as np

from d2_plugin.attach.session import attribute_of, wrap_attribute

log = logging.getLogger(__name__)

NUMPY_NAMES = {"NaN": np.nan, "Inf": np.inf, "float": float, "int": int, "object": object, "product": np.prod}
"""Names that numpy dropped in 1.24 and 2.0, and what they were."""


def repair() -> None:
    """Apply every repair that this environment needs, and log each."""
    for sentence in (_numpy(), _pillow(), _joblib(), _json()):
        if sentence:
            log.info("%s", sentence)


def _numpy() -> str | None:
    gone = [name for name in NUMPY_NAMES if name not in vars(np)]
    for name in gone:
        setattr(np, name, NUMPY_NAMES[name])
    return f"numpy {np.__version__} has no np.{', np.'.join(gone)}: restored for this process" if gone else None


def _pillow() -> str | None:
    """fudan and 4C4D hand signed bytes to PIL (utils/data_utils.py:22), which Pillow 11 and later refuse."""
    try:
        from PIL import Image, __version__
    except ImportError:
        return None
    if int(__version__.split(".")[0]) < 11:
        return None

    def fromarray(original: Callable[..., Any], obj: Any, *arguments: Any, **named: Any) -> Any:
        values = obj.view(np.uint8) if getattr(obj, "dtype", None) == np.int8 else obj
        return original(values, *arguments, **named)

    wrap_attribute(Image, "fromarray", fromarray)
    return f"Pillow {__version__} takes no signed bytes: Image.fromarray reads them as unsigned in this process"


def _joblib() -> str | None:
    """cem-4dgs reads images in processes that import its modules again, where no stand-in is (scene/__init__.py)."""
    try:
        from joblib import parallel, register_parallel_backend
    except ImportError:
        return None
    register_parallel_backend("loky", parallel.ThreadingBackend)
    return "joblib's workers are threads of this process, where the stand-ins are"


def _json() -> str:
    """cem-4dgs writes scikit-image's SSIM as JSON, which later versions return in single precision (train.py:450)."""

    def default(original: Callable[..., Any], encoder: json.JSONEncoder, o: Any) -> Any:
        return o.item() if isinstance(o, np.generic) else original(encoder, o)

    wrap_attribute(json.JSONEncoder, "default", default)
    return "numbers of numpy are written as JSON like Python's own"


def saves_parents() -> None:
    """cem-4dgs saves -1, the parent of a splat that has none, as unsigned: numpy 2 refuses what numpy 1 wrapped around.

    The `save_ply` of its class VGaussianModel then sees the number that numpy 1 wrote.
    """

    def save_ply(original: Callable[..., Any], self: Any, *arguments: Any, **named: Any) -> Any:
        parents = self._parent
        self._parent = parents.long() & 0xFFFFFFFF
        try:
            return original(self, *arguments, **named)
        finally:
            self._parent = parents

    wrap_attribute(attribute_of("scene.v_gaussian_model", "VGaussianModel"), "save_ply", save_ply)
