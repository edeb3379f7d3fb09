"""What a build of priors did, as a person reads it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean, median
from typing import Any

from d2_plugin.priors.monocular.uncertainty import NIL

SHOWN = {label: label for label in ("verified", "agreed", "mono", "far", "conflict", "empty")} | {"mono": "mono only"}
"""Columns of the summary: label and title."""

USED = ("verified", "agreed", "mono", "far")
"""Labels of pixels that the hooks can use."""

DECLARED = ("verified", "agreed", "mono")
"""Labels that also show a median sigma."""

KEPT = ("shares", "sigmas", "refused", "skill")
"""What of a record the summary keeps."""


@dataclass
class PriorSummary:
    """What a build did, as means over the frames of each camera, and what it left out and why."""

    built: int = 0
    kept: int = 0
    views: dict[tuple[str, int], dict[str, Any]] = field(default_factory=dict)
    """What the record of each view says of its `shares`, `sigmas`, `refused` and `skill`, by camera and frame."""
    notes: list[str] = field(default_factory=list)
    folder: Path | None = None
    """Where the priors are: the output, or a folder of their own in it, beside the priors of other cameras."""

    def add(self, camera: str, frame: int, record: dict[str, Any], built: bool) -> None:
        """Take one view's record into account."""
        self.built, self.kept = self.built + built, self.kept + (not built)
        self.views[camera, frame] = {"sigmas": {}} | {name: record[name] for name in KEPT if name in record}

    def add_part(self, part: PriorSummary) -> None:
        """Take in the summary of another part of the same build; notes that both have are kept once."""
        self.built, self.kept = self.built + part.built, self.kept + part.kept
        self.views |= part.views
        self.folder = part.folder or self.folder
        self.notes += [note for note in part.notes if note not in self.notes]

    @property
    def shares(self) -> dict[str, dict[str, float]]:
        """Mean share of the pixels with each label, by camera."""
        of_camera = {camera: [view["shares"] for view in self._of(camera)] for camera in self._cameras()}
        return {
            camera: {label: fmean(share[label] for share in shares) for label in shares[0]}
            for camera, shares in of_camera.items()
        }

    @property
    def refused(self) -> list[tuple[str, int, str]]:
        """Camera, frame and reason of each view whose map was refused, by frame."""
        refused = [(camera, frame, view["refused"]) for (camera, frame), view in self.views.items() if view["refused"]]
        return sorted(refused, key=lambda refusal: refusal[1])

    def _cameras(self) -> list[str]:
        return list(dict.fromkeys(camera for camera, _ in self.views))

    def _of(self, camera: str) -> list[dict[str, Any]]:
        return [view for (name, _), view in self.views.items() if name == camera]

    def _used(self, camera: str) -> int:
        """How many views of a camera have a pixel that the hooks can use."""
        return sum(any(view["shares"].get(label, 0.0) > 0 for label in USED) for view in self._of(camera))

    def sigma(self, camera: str, label: str) -> float | None:
        """Median over the frames of the median sigma of a label's pixels; None where it is infinite or paper's 0."""
        values = [value for view in self._of(camera) if (value := view["sigmas"].get(label)) is not None]
        return median(values) or None if values else None

    @property
    def usable(self) -> bool:
        """Whether any view has a pixel that the hooks can use."""
        return any(self._used(camera) for camera in self._cameras())

    def reasons(self) -> str:
        """Why views were refused, each reason with their number; empty where none was."""
        counts = Counter(reason for _, _, reason in self.refused)
        return "; ".join(f"{count}x {reason}" for reason, count in counts.most_common())

    def skill(self) -> str:
        """How good the monocular maps are where anchors were left out, in one line; empty where none were."""
        skills = [skill for view in self.views.values() if (skill := view.get("skill")) and skill["error"] is not None]
        if not skills:
            return ""
        error = median(skill["error"] for skill in skills)
        without = median(skill["error"] * (skill["gain"] or 1.0) for skill in skills)
        verdict = "" if without > NIL * error else ": they say no more than the stereo around"
        return f"{error:.1%} off where stereo was left out (median), {without:.1%} without any map{verdict}"

    def headline(self) -> str:
        """The prior in one line: how many views have one, which cameras have none, and every reason of a refusal."""
        used = {camera: self._used(camera) for camera in self._cameras()}
        without = [camera for camera, count in used.items() if not count]
        views = "1 view is" if len(self.views) == 1 else f"{len(self.views)} views are"
        parts = [f"prior: {sum(used.values())} of {views} usable"]
        parts += [f"none of camera{'' if len(without) == 1 else 's'} {', '.join(without)}"] if without else []
        parts += [f"maps refused {self.reasons()}"] if self.refused else []
        return "; ".join(parts)

    def as_dict(self) -> dict[str, Any]:
        """For metrics.json: the same whether the priors were built now or before."""
        cameras = {
            camera: {
                "views": len(self._of(camera)),
                "usable": self._used(camera),
                "shares": shares,
                "sigma": {label: self.sigma(camera, label) for label in DECLARED},
            }
            for camera, shares in self.shares.items()
        }
        refused = [{"camera": camera, "frame": frame, "reason": reason} for camera, frame, reason in self.refused]
        return {"headline": self.headline(), "cameras": cameras, "refused": refused, "notes": list(self.notes)}

    def __str__(self) -> str:
        lines = [f"{self.built} priors built, {self.kept} kept", *self._share_lines(), *self._sigma_lines()]
        lines += [f"monocular maps: {said}"] if (said := self.skill()) else []
        reasons = Counter(reason for _, _, reason in self.refused)
        for reason, count in reasons.most_common():
            examples = [f"{camera}/{frame}" for camera, frame, why in self.refused if why == reason][:3]
            lines.append(f"refused {count}x ({', '.join(examples)}{', ...' if count > 3 else ''}): {reason}")
        return "\n".join([*lines, *self.notes])

    def _share_lines(self) -> list[str]:
        lines = [f"{'camera':12}" + "  ".join(f"{title:>9}" for title in SHOWN.values())]
        for camera, share in self.shares.items():
            values = (share.get(label, 0.0) for label in SHOWN)
            lines.append(f"{camera:12}" + "  ".join(f"{value:9.1%}" for value in values))
        return lines

    def _sigma_lines(self) -> list[str]:
        """Median sigma per camera and label; nothing where no sigma was declared, as in the paper."""
        rows = {camera: [self.sigma(camera, label) for label in DECLARED] for camera in self.shares}
        if all(value is None for values in rows.values() for value in values):
            return []
        lines = [f"{'sigma':12}" + "  ".join(f"{SHOWN[label]:>9}" for label in DECLARED)]
        for camera, values in rows.items():
            shown = (f"{'-':>9}" if value is None else f"{value:9.2%}" for value in values)
            lines.append(f"{camera:12}" + "  ".join(shown))
        return lines
