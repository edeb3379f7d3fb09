"""Where monocular maps come from: a network, whose predictions are cached, or maps that lie beside the images."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.priors.frame import Frame, digest
from d2_plugin.priors.monocular.network import MonocularModel, upsample
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.recordings.recording import MonoKind, Recording
from d2_plugin.store.files import EntryFolder, hash_of

MONO_VERSION = 2  # raise it when prediction changes what it returns, so that caches are not trusted


class MapsOnDisk:
    """Monocular maps that lie beside the images of a recording; `kind` says what they are."""

    def __init__(self, recording: Recording, kind: MonoKind) -> None:
        self.recording, self.kind = recording, kind
        self.about = f"{kind} maps on disk" + (" (emulated)" if recording.mono_emulated else "")

    def key(self, camera: str, frame: Frame) -> str:
        """Hash of the map itself."""
        stored = self.recording.mono(camera, frame.number)
        return "none" if stored is None else digest(stored)

    def map(self, camera: str, frame: Frame) -> np.ndarray | None:
        """The stored map, enlarged to the image."""
        stored = self.recording.mono(camera, frame.number)
        return None if stored is None else upsample(stored, *frame.images[camera].shape[:2])


class MapsFromNetwork:
    """Predictions of an ONNX network, cached at the network's output size."""

    def __init__(self, model: MonocularModel, cache: Path) -> None:
        self.model, self.kind, self.entries = model, model.kind, EntryFolder(cache, synced=False)
        self.about = f"{model.kind} maps of {model.path.name} on {model.provider}, preprocessing {model.preprocessing}"
        self._fingerprint = model.fingerprint()

    def key(self, camera: str, frame: Frame) -> str:
        """Hash of network and image."""
        return hash_of(MONO_VERSION, self._fingerprint, frame.hashes[camera])

    def map(self, camera: str, frame: Frame) -> np.ndarray:
        """The prediction, computed once."""
        key = self.key(camera, frame)
        entry = self.entries.find_current(camera, frame.number, key)
        if entry is None:
            prediction = self.model.predict(frame.images[camera])
            self.entries.write(camera, frame.number, prediction, {"key": key, "about": self.about})
        else:
            prediction = entry.array()
        return upsample(prediction, *frame.images[camera].shape[:2])


MonoSource = MapsOnDisk | MapsFromNetwork
"""Where monocular maps come from."""


def mono_source(recording: Recording, settings: PriorSettings, cache: Path) -> MonoSource | None:
    """The monocular source that settings and recording name, or None where there is none.

    Raises:
        D2Error: a network without a declared kind, a declared kind that contradicts the recording's, or relative maps
            along the ray.
    """
    source: MonoSource
    if settings.mono_onnx:
        if settings.mono_kind is None:
            raise D2Error(
                f"what {settings.mono_onnx} predicts is not declared: say mono_kind = relative (inverse depth, as most "
                "Depth Anything V2 models) or metric"
            )
        model = MonocularModel(
            settings.mono_onnx, settings.mono_kind, settings.mono_preprocessing, settings.mono_threads
        )
        source = MapsFromNetwork(model, cache)
    elif recording.mono_kind is None:
        return None
    elif settings.mono_kind not in (None, recording.mono_kind):
        raise D2Error(
            f"mono_kind = {settings.mono_kind} but the maps of {recording.name} are declared {recording.mono_kind}: "
            "leave mono_kind out, or correct mono/mono.json"
        )
    else:
        source = MapsOnDisk(recording, recording.mono_kind)
    if source.kind == "relative" and settings.mono_along == "ray":
        raise D2Error(
            "mono_along = ray needs metric maps but these are relative, whose shift is that of planar inverse depth: "
            "leave mono_along out"
        )
    return source
