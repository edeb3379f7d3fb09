"""A prior store under the names that an export of its recording gave to cameras and frames.

`export.json` beside the exported images holds both names. The configuration gives its folder (`exported`), or it is
looked for above the path of a training image.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.errors import refuse_unknown
from d2_plugin.protocol import EXPORT_FILE, DepthPrior, call_optional
from d2_plugin.reading import field, parsing, read_json
from d2_plugin.store.store import PriorStore
from d2_plugin.values import fitting

log = logging.getLogger(__name__)

REMEDY = "give the folder that `d2 export-recording` wrote"


class RenamedStore:
    """The priors of the source recording under the names of its export."""

    def __init__(self, store: Any, cameras: dict[str, str], frames: dict[int, int]) -> None:
        """`cameras` and `frames` map those of the export to those of the source."""
        self.store, self.sources, self.frames = store, cameras, frames

    @classmethod
    def of_export(cls, store: Any, folder: Path) -> RenamedStore:
        """The priors under the names of an exported folder; names that the source uses itself are kept."""
        path = folder / EXPORT_FILE
        described = read_json(path, REMEDY)
        names = field(described, "cameras", dict, str(path), REMEDY)
        numbers = field(described, "frames", dict, str(path), REMEDY)
        cameras = {fitting(str, exported, f"a camera in {path}"): source for source, exported in names.items()}
        with parsing(f"the frames in {path}", REMEDY):
            frames = {int(exported): int(source) for source, exported in numbers.items()}
        return cls(store, cameras, frames)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names, in the export, of the cameras that have priors."""
        known = getattr(self.store, "cameras", None)
        return tuple(name for name, source in self.sources.items() if known is None or source in known)

    def tried(self) -> Any:
        """See `PriorStore.tried`."""
        return call_optional(self.store, "tried")

    def prior(self, camera: str, frame: int) -> DepthPrior | None:
        """D* of one view, or None where there is none; a camera that the export does not have is refused."""
        return self._of_source("prior", camera, frame)

    def coded(self, camera: str, frame: int) -> Any:
        """The same as it is stored, where the store has that."""
        return self._of_source("coded" if hasattr(self.store, "coded") else "prior", camera, frame)

    def coded_underway(self, camera: str, frame: int, quarter: int) -> Any:
        """See `PriorStore.coded_underway`, not coded if the store has none; None if the next frame is not exported."""
        name = "coded_underway" if hasattr(self.store, "coded_underway") else "underway"
        underway = self._of_source(name, camera, frame, quarter)
        exported = {source: number for number, source in self.frames.items()}
        return (exported[underway[0]], underway[1]) if underway is not None and underway[0] in exported else None

    def camera(self, camera: str, frame: int) -> Any:
        """The camera that one prior was built for, or None where the store does not say."""
        return self._of_source("camera", camera, frame)

    def _of_source(self, what: str, camera: str, frame: int, *further: int) -> Any:
        refuse_unknown("camera of the export", [camera], self.sources)
        if frame not in self.frames or camera not in self.cameras:
            return None  # a camera of the recording that the prior was not built for is trained without one
        method = getattr(self.store, what, None)
        return None if method is None else method(self.sources[camera], self.frames[frame], *further)


def opened(prior: str, exported: str | None) -> Any:
    """The store in the folder `prior`, under the names of an export of its recording where one is given."""
    store = PriorStore.open(Path(prior))
    return store if exported is None else RenamedStore.of_export(store, Path(exported))


def renamed_by(store: Any, image: str | None) -> Any:
    """`store`, or the same one under other names, where the trainer's image lies in an export of its recording."""
    folder = export_above(image) if image else None
    if folder is None or isinstance(store, RenamedStore) or not is_source_of(store, folder):
        return store
    log.info("the images are an export of the prior's recording: names are translated by %s", folder / EXPORT_FILE)
    return RenamedStore.of_export(store, folder)


def export_read(prior: Path, source: Path) -> Path | None:
    """The export in which a trainer's `source` lies, if the priors are those of its recording."""
    folder = export_above(str(source / "image"))
    if folder is None or not (prior / "store.json").is_file():
        return None
    return folder if is_source_of(PriorStore.described(prior), folder) else None


def export_above(image: str) -> Path | None:
    """The folder with an `export.json` that an image lies in, at most three folders below it."""
    parents = list(Path(image).parents)[:3]
    return next((folder for folder in parents if (folder / EXPORT_FILE).is_file()), None)


def is_source_of(store: Any, folder: Path) -> bool:
    """Whether the priors of `store` are those of the recording that an export was written from, not of the export.

    Both say the calibrations of their cameras under their own names; where the export kept all names, the name of the
    recording decides.
    """
    about, described = getattr(store, "about", None) or {}, read_json(folder / EXPORT_FILE, REMEDY)
    ours, theirs = (part.get("calibrations") or {} for part in (about, described))
    shared = ours.keys() & theirs.keys()
    if not shared or not all(_same_at_any_size(ours[name], theirs[name]) for name in shared):
        return False
    kept = all(name == exported for name, exported in described.get("cameras", {}).items())
    return not kept or about.get("recording") == described.get("source")


def _same_at_any_size(ours: dict[str, Any], theirs: dict[str, Any]) -> bool:
    """Whether two calibrations are of one camera: a trainer that halves images has a prior of half the export's size.

    Lenses in units of the size may differ by what halving an odd number of pixels does.
    """
    lens, other = (np.asarray(one["K"])[:2] / np.asarray(one["size"])[:, None] for one in (ours, theirs))
    same_pose = np.allclose(ours["T_camera_world"], theirs["T_camera_world"], rtol=1e-6, atol=1e-9)
    return same_pose and np.allclose(lens, other, atol=0.01)
