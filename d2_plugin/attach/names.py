"""A prior store under the names that an export gave to cameras and frames (see d2_plugin.captures.export.export)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from d2_plugin.captures.export.export import EXPORT_FILE
from d2_plugin.errors import unknown_name
from d2_plugin.protocol import DepthPrior
from d2_plugin.reading import field, parsing, read_json
from d2_plugin.values import fitting

GIVE = "give the folder that `d2 export-capture` wrote"


class RenamedStore:
    """The priors of the source capture, asked for by the names of its export."""

    def __init__(self, store: Any, cameras: dict[str, str], frames: dict[int, int]) -> None:
        """`cameras` and `frames` map those of the export to those of the source."""
        self.store, self.cameras, self.frames = store, cameras, frames

    @classmethod
    def of_export(cls, store: Any, folder: Path) -> RenamedStore:
        """The priors under the names of an exported folder; names that the source uses itself are kept."""
        path = folder / EXPORT_FILE
        described = read_json(path, GIVE)
        names = field(described, "cameras", dict, str(path), GIVE)
        numbers = field(described, "frames", dict, str(path), GIVE)
        cameras = {fitting(str, exported, f"a camera in {path}"): source for source, exported in names.items()}
        with parsing(f"the frames in {path}", GIVE):
            frames = {int(exported): int(source) for source, exported in numbers.items()}
        return cls(store, cameras, frames)

    def prior(self, camera: str, frame: int) -> DepthPrior | None:
        """D* of one view, or None where there is none; a camera that the export does not have is refused."""
        return self._asked("prior", camera, frame)

    def camera(self, camera: str, frame: int) -> Any:
        """The camera that one prior was built for, or None where the store does not say."""
        return self._asked("camera", camera, frame)

    def _asked(self, what: str, camera: str, frame: int) -> Any:
        if camera not in self.cameras:
            raise unknown_name("camera of the export", camera, self.cameras)
        if frame not in self.frames:
            return None
        ask = getattr(self.store, what, None)
        return None if ask is None else ask(self.cameras[camera], self.frames[frame])
