"""A contact sheet of a prior store: picture, D* and labels side by side, to be looked at before training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import numpy as np

from d2_plugin.captures.capture import Capture
from d2_plugin.errors import D2Error
from d2_plugin.priors.extras import opencv
from d2_plugin.priors.store import PriorStore
from d2_plugin.protocol import DepthPrior, Label

LABEL_COLORS = {
    Label.EMPTY: (40, 40, 40),
    Label.MONO: (70, 110, 200),
    Label.VERIFIED: (80, 190, 90),
    Label.CONFLICT: (210, 70, 60),
    Label.AGREED: (60, 190, 200),
    Label.FAR: (200, 215, 235),
}
"""RGB of each label in the sheet."""

CAPTION = 18  # height of the line above a row, pixels


def contact_sheet(
    store: PriorStore,
    capture: Capture,
    path: Path | str,
    frames: Sequence[int] | None = None,
    width: int = 320,
) -> Path:
    """Write a PNG with one row per camera and frame: picture | D* in false colour (near is red) | labels.

    Args:
        store: the priors.
        capture: where the pictures come from.
        path: the file to write.
        frames: up to three frames spread over the store where None.
        width: of one picture in the sheet, pixels.

    Raises:
        D2Error: the store has no prior at any of the frames.
    """
    cv2 = opencv("the contact sheet")
    chosen = _spread(store.frames, 3) if frames is None else list(frames)
    rows = [
        _row(cv2, capture.image(camera, frame), prior, _caption(store, camera, frame), width)
        for frame in chosen
        for camera in store.cameras
        if (prior := store.prior(camera, frame)) is not None
    ]
    if not rows:
        raise D2Error(f"{store.path} has no prior at frames {', '.join(map(str, chosen))}: build them first")
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), np.concatenate(rows)[..., ::-1]):
        raise D2Error(f"the contact sheet could not be written to {path}: choose a name that ends in .png")
    return path


def depth_colors(depth: np.ndarray) -> np.ndarray:
    """False colours RGB uint8 [H, W, 3] of inverse depth between its 2nd and 98th percentile, black where empty."""
    cv2 = opencv("the contact sheet")
    known = depth > 0
    if not known.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    inverse = np.where(known, 1 / np.where(known, depth, 1), 0)
    low, high = np.percentile(inverse[known], (2, 98))
    level = np.clip((inverse - low) / max(high - low, np.finfo(np.float32).tiny), 0, 1)
    colors = cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1]
    return np.where(known[..., None], colors, 0)


def label_colors(labels: np.ndarray) -> np.ndarray:
    """RGB uint8 [H, W, 3]: grey empty, blue mono-only, green verified, red conflict, cyan agreed, lilac far."""
    palette = np.array([LABEL_COLORS[label] for label in Label], np.uint8)
    return palette[labels]


def _row(cv2: ModuleType, image: np.ndarray, prior: DepthPrior, caption: str, width: int) -> np.ndarray:
    size = (width, round(width * image.shape[0] / image.shape[1]))
    panels = [
        cv2.resize(image, size, interpolation=cv2.INTER_AREA),
        cv2.resize(depth_colors(prior.depth.numpy()), size, interpolation=cv2.INTER_NEAREST),
        cv2.resize(label_colors(prior.labels.numpy()), size, interpolation=cv2.INTER_NEAREST),
    ]
    head = np.full((CAPTION, 3 * width, 3), 255, np.uint8)
    cv2.putText(head, caption, (4, CAPTION - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([head, np.concatenate(panels, axis=1)])


def _caption(store: PriorStore, camera: str, frame: int) -> str:
    record = store.record(camera, frame) or {}
    if record["refused"]:
        return f"camera {camera}, frame {frame}: refused, {record['refused']}"
    shares = ", ".join(f"{name} {share:.0%}" for name, share in record["shares"].items())
    source = f"; {record['monocular']}" if record["monocular"] else ""
    return f"camera {camera}, frame {frame}: {shares}{source}"


def _spread(frames: Sequence[int], count: int) -> list[int]:
    picked = np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int))
    return [frames[index] for index in picked]
