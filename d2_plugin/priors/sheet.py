"""A contact sheet of a prior store: image, D*, labels and sigma side by side, to be looked at before training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.protocol import DepthPrior, Label
from d2_plugin.recordings.images import opencv, write_png
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.selection import spread
from d2_plugin.store.store import PriorStore
from d2_plugin.values import checked_arguments

LABEL_COLORS = {
    Label.EMPTY: (40, 40, 40),
    Label.MONO: (70, 110, 200),
    Label.VERIFIED: (80, 190, 90),
    Label.CONFLICT: (210, 70, 60),
    Label.AGREED: (60, 190, 200),
    Label.FAR: (200, 215, 235),
}
"""RGB of each label in the sheet."""

SURE, UNSURE = 0.001, 0.5
"""Sigma at the dark and at the bright end of its colours, which are logarithmic; an infinite sigma is grey."""
UNKNOWN = (120, 120, 120)
"""RGB of a pixel whose depth has an infinite sigma."""
TITLES = (
    "image",
    "D*: near red, far blue, none black",
    "green verified, cyan agreed, blue mono, pale far, red conflict",
    f"sigma: dark {SURE:.1%}, bright {UNSURE:.0%}, grey unknown",
)
"""Of the four panels of a row."""

CAPTION = 18  # height of a line of text, pixels


@checked_arguments
def contact_sheet(
    store: PriorStore,
    recording: Recording,
    path: Path | str,
    frames: Sequence[int] | None = None,
    width: int = 320,
) -> Path:
    """Write a PNG with one row per camera and frame: image | D* (near is red) | labels | sigma.

    Below them, what the cameras would see halfway to the next frames, where the store has it.

    Args:
        store: the priors.
        recording: where the images come from.
        path: the file to write.
        frames: up to three frames spread over the store where None.
        width: of one image in the sheet, pixels.

    Raises:
        D2Error: the store has no prior at any of the frames.
    """
    cv2 = opencv("the contact sheet")
    shared = [frame for frame in store.frames if frame in recording.frames]
    chosen = spread(shared, 3) if frames is None else list(frames)
    rows = [
        _row(cv2, recording.image(camera, frame), prior, _caption(store, camera, frame), width)
        for frame in chosen
        for camera in store.cameras
        if (prior := store.prior(camera, frame)) is not None
    ]
    for camera, frame in ((camera, frame) for frame in chosen for camera in store.cameras):
        halfway = store.underway(camera, frame, 2)
        if halfway is not None and halfway[1].colors is not None:
            unknown = float((halfway[1].labels == Label.CONFLICT).float().mean())
            about = f"camera {camera}, halfway from frame {frame} to {halfway[0]}: motion not known at {unknown:.1%}"
            rows.append(_row(cv2, halfway[1].colors.numpy(), halfway[1], about, width))
    if not rows:
        raise D2Error(f"{store.path} has no prior at frames {', '.join(map(str, chosen))}: build them first")
    titles = np.concatenate([_line(cv2, title, width, 0.32) for title in TITLES], axis=1)
    path = Path(path)
    write_png(path, np.concatenate([titles, *rows]))
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
    """RGB uint8 [H, W, 3]: grey empty, blue mono-only, green verified, red conflict, cyan agreed, pale blue far."""
    palette = np.array([LABEL_COLORS[label] for label in Label], np.uint8)
    return palette[labels]


def sigma_colors(sigma: np.ndarray | None, depth: np.ndarray) -> np.ndarray:
    """RGB uint8 [H, W, 3] of log sigma from `SURE` (dark) to `UNSURE` (bright); `UNKNOWN` if infinite, black if empty.

    Args:
        sigma: relative standard deviation [H, W]; None where none is declared, which is infinite.
        depth: D* [H, W], 0 where there is none.
    """
    cv2 = opencv("the contact sheet")
    sigma = np.full(depth.shape, np.inf, np.float32) if sigma is None else sigma
    inside = np.clip(sigma, SURE, UNSURE)
    level = np.log(inside / SURE) / np.log(UNSURE / SURE)
    colors = cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_INFERNO)[..., ::-1]
    darkest = (20, 12, 30)  # a depth that is certain must not look like none
    shown = np.where(np.isfinite(sigma)[..., None], np.maximum(colors, darkest), UNKNOWN)
    return np.where((depth > 0)[..., None], shown, 0).astype(np.uint8)


def _row(cv2: ModuleType, image: np.ndarray, prior: DepthPrior, caption: str, width: int) -> np.ndarray:
    size = (width, min(max(1, round(width * image.shape[0] / image.shape[1])), 10 * width))
    depth, labels = prior.depth.numpy(), prior.labels.numpy()
    sigma = None if prior.sigma is None else prior.sigma.numpy()
    # Of a far pixel only a lower bound is known, so it takes no part in the colours of depth and sigma.
    far = labels == Label.FAR
    surface = np.where(far, 0, depth)
    maps = [depth_colors(surface), label_colors(labels), sigma_colors(sigma, surface)]
    for map_ in maps:
        map_[far] = LABEL_COLORS[Label.FAR]
    panels = [cv2.resize(image, size, interpolation=cv2.INTER_AREA)]
    panels += [cv2.resize(map_, size, interpolation=cv2.INTER_NEAREST) for map_ in maps]
    return np.concatenate([_line(cv2, caption, len(panels) * width, 0.4), np.concatenate(panels, axis=1)])


def _line(cv2: ModuleType, text: str, width: int, size: float) -> np.ndarray:
    """One line of black text on white, RGB uint8 [CAPTION, width, 3]."""
    line = np.full((CAPTION, width, 3), 255, np.uint8)
    cv2.putText(line, text, (4, CAPTION - 5), cv2.FONT_HERSHEY_SIMPLEX, size, (0, 0, 0), 1, cv2.LINE_AA)
    return line


def _caption(store: PriorStore, camera: str, frame: int) -> str:
    record = store.record(camera, frame) or {}
    sigmas = record.get("sigmas", {})
    shares = ", ".join(
        f"{name} {share:.0%}" + (f" (sigma {100 * sigmas[name]:.2g} %)" if sigmas.get(name) else "")
        for name, share in record["shares"].items()
        if share > 0
    )
    source = "".join(f"; {about}" for name in ("monocular", "several") if (about := record.get(name)))
    alignment = (record.get("multiview") or {}).get("alignment", {})
    if alignment and alignment["status"] not in ("ok", "across"):
        source += f", refused: {alignment['reason']}"
    refused = f"; map refused: {record['refused']}" if record["refused"] else ""
    return f"camera {camera}, frame {frame}: {shares}{refused or source}"
