"""Depth priors on disk: one memory-mapped array and one record per camera and frame.

    STORE/store.json                     format, and what the store was built for: cameras, frames, the recording
    STORE/priors/CAMERA/FRAME.npy        structured [H, W]: depth uint16 (logarithmic, 0 = empty), label,
                                         sigma uint8 (logarithmic, 0 = 0, 255 = infinite), RGB uint8
    STORE/priors/CAMERA/FRAME.json       record: a, b, gap, status, shares, settings, hashes, depth range, checksum
    STORE/between/QUARTER/CAMERA/FRAME.npy, .json  the same 1 to 3 quarters of the way from a frame to the next one
                                         (`d2_plugin.priors.between`)
    STORE/trials.json                    what of these priors is worth inserting (`d2_plugin.runs.prior.trials`)
    STORE/cache/...                      stereo and monocular maps, so that other fusion settings cost seconds
    STORE/cameras/NAME+NAME/...          a store of its own for the priors of other cameras of the same recording

The image lies beside them, at 7 bytes per pixel in all: inserted Gaussians take its colours, and training need not
open the recording for them. Every file is written under a temporary name and renamed, the array before its record: a
record therefore vouches for its array, a build that is killed loses the frame in work, and readers never see half a
file. Every record is sealed and holds the checksum of its array (`d2_plugin.store.files`).

A store belongs to one recording, known by its calibrations and images and not by its folder's name, and to one set of
cameras, because a prior is what these cameras saw together. Nothing but other settings, a changed image or damage
ever replaces a file.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
import torch

from d2_plugin.durable import (
    Kind,
    is_leftover,
    make_folder,
    read_table,
    refuse_inside_images,
    remove_leftovers,
    write_table,
)
from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.protocol import CameraRecord, DepthPrior
from d2_plugin.store.files import Entry, EntryFolder, hash_of
from d2_plugin.store.maps import PRIOR_DTYPE, CodedPrior, DepthRange, FusedPrior, check_maps, encode_sigma
from d2_plugin.values import checked_arguments

FORMAT = 4
"""Of store.json and of the arrays; raise it when either changes."""

STORE = Kind("prior store", FORMAT, "build the priors anew in another folder")
"""The table store.json."""

TRIALS = Kind("table of trials", 1, "delete the file, `d2 priors` makes it again")
"""The table trials.json."""

QUARTERS = (1, 2, 3)
"""Of the way from a frame to the next one, at which something is known between them."""

OTHERS = "cameras"
"""Folder of a store that holds the stores of other sets of cameras."""


class PriorStore:
    """Priors of one recording, by camera and frame; safe for many readers, and for writers of different frames."""

    def __init__(self, path: Path | str, cameras: Sequence[str], frames: Sequence[int], about: dict[str, Any]) -> None:
        """Use `open` or `create`."""
        self.path, self.about = Path(path), about
        self.cameras, self.frames = tuple(cameras), tuple(frames)
        self.entries = EntryFolder(self.path / "priors")
        self._intact: set[Path] = set()
        self.between = {quarter: EntryFolder(self.path / "between" / f"{quarter}") for quarter in QUARTERS}
        """The instants so many quarters of the way from a frame to the next one, by the earlier frame."""

    @classmethod
    @checked_arguments
    def open(cls, path: Path | str) -> PriorStore:
        """Open a store for reading; every record is checked against the header and size of its array.

        Raises:
            D2Error: no store there, another format, or a damaged entry, which is named.
        """
        store = cls.described(Path(path))
        for camera in store.cameras:
            for frame in store.frames:
                entry = store.entries.find(camera, frame)
                if entry is None:
                    continue
                problem = entry.problem(PRIOR_DTYPE)
                if problem:
                    raise D2Error(f"the prior of camera {camera}, frame {frame} is damaged ({problem}): {_REBUILD}")
        return store

    @classmethod
    @checked_arguments
    def create(
        cls, path: Path | str, cameras: Sequence[str], frames: Sequence[int], about: dict[str, Any]
    ) -> PriorStore:
        """Open the store at `path` for building, or begin one; `about` describes its recording.

        Frames that were built for the same cameras before stay part of the store, and so does the order of its
        cameras. Other cameras of the same recording get a store of their own in it, see `located`. Where nothing has
        to be added nothing is written: a finished store may lie on a read-only disk.

        Raises:
            D2Error: the folder holds something else, or the priors of another recording.
            CannotWrite: the disk is full, broken or not ours.
        """
        from d2_plugin.locks import in_turn  # who reads needs none

        root = Path(path)
        refuse_inside_images(root)
        with in_turn(make_folder(root)):
            existing = cls._existing(root, about)
            place = cls.place(root, cameras)
            if place != root:
                existing = cls._existing(make_folder(place), about)
            if existing is None:
                store = cls(place, cameras, frames, about)
            else:
                store = cls(place, existing.cameras, sorted({*existing.frames, *frames}), existing.about)
            if existing is None or store.frames != existing.frames:
                described = {"cameras": store.cameras, "frames": store.frames, "about": store.about}
                write_table(place / "store.json", described, STORE)
        return store

    @classmethod
    def place(cls, path: Path | str, cameras: Sequence[str]) -> Path:
        """Where priors of exactly these cameras belong: `path`, or a folder within it where the store is of others."""
        root = Path(path)
        if not (root / "store.json").is_file() or set(cls.described(root).cameras) == set(cameras):
            return root
        return root / OTHERS / _joined(cameras)

    @classmethod
    def located(cls, path: Path | str, cameras: Sequence[str]) -> Path:
        """The folder below `path` whose priors were built from exactly these cameras; `path` where there is none."""
        place = cls.place(path, cameras)
        return place if (place / "store.json").is_file() else Path(path)

    @classmethod
    def _existing(cls, path: Path, about: dict[str, Any]) -> PriorStore | None:
        """The store at `path` as it stands, None where nothing is there; another recording's is refused."""
        if (path / "store.json").is_file():
            store = cls.described(path)
            reason = other_recording(store.about, about)
            if reason is not None:
                raise not_of(path, store.about, about, reason)
            return store
        if path.exists() and not all(is_leftover(inside) for inside in path.iterdir()):
            raise D2Error(f"{path} is not empty and holds no prior store: choose another output folder")
        return None

    @classmethod
    def described(cls, path: Path) -> PriorStore:
        """The store at `path` by its description alone; no record is looked at."""
        if not (path / "store.json").is_file():
            build = f"d2 priors RECORDING --output {quote(str(path))}"
            raise D2Error(f"no depth priors at {path}: build them with `{build}`")
        table = read_table(path / "store.json", STORE)
        return cls(path, table["cameras"], table["frames"], table["about"])

    @checked_arguments
    def prior(self, camera: str, frame: int) -> DepthPrior | None:
        """D* of one view as tensors on the CPU, or None where the store has none.

        Raises:
            D2Error: an unknown camera, or an array that does not match the checksum of its record.
        """
        coded = self.coded(camera, frame)
        return None if coded is None else coded.decoded()

    def coded(self, camera: str, frame: int) -> CodedPrior | None:
        """The same, not decoded: what a training keeps in memory. The checksum is compared at the first reading."""
        entry = self._entry(camera, frame)
        return None if entry is None else self._coded(entry)

    def underway(self, camera: str, frame: int, quarter: int) -> tuple[int, DepthPrior] | None:
        """The next frame, and what the camera would see 1, 2 or 3 quarters of the way there; None where the store has
        no such instants.

        Pixels whose motion is not known are labelled as conflicts, and only what moves has a depth.
        """
        coded = self.coded_underway(camera, frame, quarter)
        return None if coded is None else (coded[0], coded[1].decoded())

    def coded_underway(self, camera: str, frame: int, quarter: int) -> tuple[int, CodedPrior] | None:
        """The same, not decoded."""
        entry = self.between[quarter].find(camera, frame)
        return None if entry is None else (entry.record["next"], self._coded(entry))

    def _coded(self, entry: Entry) -> CodedPrior:
        stored = entry.array(PRIOR_DTYPE, intact=entry.path in self._intact)
        self._intact.add(entry.path)
        return CodedPrior.of(stored, DepthRange(*entry.record["depth_range"]))

    @checked_arguments
    def record(self, camera: str, frame: int) -> dict[str, Any] | None:
        """What is known about one prior: alignment, shares, settings, hashes; None where the store has none."""
        entry = self._entry(camera, frame)
        return None if entry is None else entry.record

    @property
    def contents(self) -> str:
        """Hash of what all these priors were built from."""
        records = (self.record(camera, frame) or {} for camera in self.cameras for frame in self.frames)
        return hash_of([record.get("key") for record in records])

    def tried(self) -> dict[str, Any] | None:
        """What trials with these very priors showed, as `Trials.as_dict` has it; None where there were none."""
        try:
            table = read_table(self.path / "trials.json", TRIALS)
        except FileNotFoundError:
            return None
        return table if table.pop("contents") == self.contents else None

    def camera(self, camera: str, frame: int) -> CameraRecord | None:
        """The camera that one prior was built for; None where the store has none or does not say."""
        described = (self.record(camera, frame) or {}).get("camera")
        if described is None:
            return None
        pose = torch.tensor(described["T_camera_world"], dtype=torch.float64)
        return CameraRecord(torch.tensor(described["K"], dtype=torch.float64), pose)

    def write(
        self, camera: str, frame: int, prior: FusedPrior, record: dict[str, Any], entries: EntryFolder | None = None
    ) -> None:
        """Store all maps of one prior and its record, among the priors or among `between`.

        Raises:
            D2Error: no colours or those of another size, depth that is not finite or negative, sigma that is NaN or
                negative, or labels that contradict the depth.
        """
        check_maps(prior, f"the prior of camera {camera}, frame {frame}")
        depth_range = DepthRange.of(prior.depth)
        codes = np.empty(prior.depth.shape, PRIOR_DTYPE)
        codes["depth"], codes["label"], codes["color"] = depth_range.encode(prior.depth), prior.labels, prior.colors
        codes["sigma"] = encode_sigma(prior.sigma)
        about = {**record, "depth_range": [depth_range.near, depth_range.far]}
        (entries or self.entries).write(camera, frame, codes, about)

    @contextmanager
    def building(self) -> Iterator[None]:
        """Write priors beside other processes that do, also of other cameras in the same folder.

        The first of them removes what killed builds left, and what is damaged.
        """
        from d2_plugin.locks import in_turn, one_of_many

        above = self.path.parents[1] if self.path.parent.name == OTHERS else self.path
        root = above if (above / "store.json").is_file() else self.path

        def tidy() -> None:
            with in_turn(root):
                remove_leftovers(root)
                for camera in self.cameras:
                    for frame in self.frames:
                        self.entries.drop_damaged(camera, frame)

        with one_of_many(make_folder(root / "priors"), tidy):
            yield

    def _entry(self, camera: str, frame: int) -> Entry | None:
        if camera not in self.cameras:
            raise D2Error(f"{unknown_name('camera of the prior store', camera, self.cameras)}; {_OTHER_NAMES}")
        return self.entries.find(camera, frame)


_OTHER_NAMES = (
    "if it was not among the --train-cameras of `d2 priors`, build them with it; if the images were written by "
    "`d2 export-recording`, set `exported` in the configuration to the folder of its export.json; else give the "
    "adapter a function `key` from a camera object to PriorKey(camera, frame)"
)


def _joined(cameras: Sequence[str]) -> str:
    """A folder's name for a set of cameras; no other set has it."""
    names = "+".join(sorted(cameras))
    plain = re.fullmatch(r"[\w.+-]{1,80}", names) and set(names) != {"."} and names.count("+") < len(cameras)
    return names if plain else hash_of(sorted(cameras))


_REBUILD = "run `d2 priors` again with the same output folder, which rebuilds what is damaged"


def other_recording(stored: dict[str, Any], given: dict[str, Any]) -> str | None:
    """Why two descriptions (`describe_recording`) are of different recordings; None if of one.

    The name decides only where one of them holds no calibration.
    """
    ours, theirs = given.get("calibrations"), stored.get("calibrations")
    if not ours or not theirs:
        return None if stored == given else ""
    shared = sorted(ours.keys() & theirs.keys())
    if not shared:
        return "they have no camera in common"
    moved = [name for name in shared if not _same_camera(ours[name], theirs[name])]
    if not moved:
        return None
    here, there = ("x".join(map(str, cameras[moved[0]]["size"])) for cameras in (ours, theirs))
    if here != there:
        return f"camera {moved[0]} has {there} pixels there and {here} here"
    return f"camera {moved[0]} has another lens or pose"


def not_of(path: Path, stored: dict[str, Any], given: dict[str, Any], reason: str) -> D2Error:
    """The error for a store that belongs to another recording."""
    why = f" ({reason})" if reason else ""
    return D2Error(
        f"{path} holds the priors of {stored.get('recording')}, not of {given.get('recording')}{why}: "
        "choose another output folder, or the recording and the --downscale that it was built with"
    )


def _same_camera(ours: dict[str, Any], theirs: dict[str, Any]) -> bool:
    """Whether two calibrations are one, up to the last digits, which differ from machine to machine."""
    if ours["size"] != theirs["size"]:
        return False
    return all(np.allclose(ours[key], theirs[key], rtol=1e-6, atol=1e-9) for key in ("K", "T_camera_world"))
