"""What a build of priors did, as a person reads it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

SHOWN = {
    "verified": "verified",
    "agreed": "agreed",
    "mono only": "mono",
    "far": "far",
    "conflict": "conflict",
    "empty": "empty",
}
"""Columns of the summary, and the share each shows."""

USED = ("verified", "agreed", "mono", "far")
"""Labels of pixels that the hooks can use."""

DECLARED = {"verified": "verified", "agreed": "agreed", "mono only": "mono"}
"""Columns that also show a median sigma."""


@dataclass
class PriorSummary:
    """What a build did, as means over the frames of each camera, and what it left out and why."""

    built: int = 0
    kept: int = 0
    shares: dict[str, dict[str, float]] = field(default_factory=dict)
    """Mean share of the pixels with each label, by camera."""
    sigmas: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    """Median sigma of each frame's pixels with each label, by camera; frames without a finite one are left out."""
    refused: list[tuple[str, int, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    folder: Path | None = None
    """Where the priors are: the output, or a folder of their own in it, beside the priors of other cameras."""
    _counts: Counter[str] = field(default_factory=Counter)
    _used: Counter[str] = field(default_factory=Counter)
    """Views with a usable pixel, by camera."""

    def add(self, camera: str, frame: int, record: dict[str, Any], built: bool) -> None:
        """Take one view's record into account."""
        self.built, self.kept = self.built + built, self.kept + (not built)
        count = self._counts[camera]
        mean = self.shares.setdefault(camera, dict.fromkeys(record["shares"], 0.0))
        for label, share in record["shares"].items():
            mean[label] += (share - mean[label]) / (count + 1)
        self._counts[camera] += 1
        self._used[camera] += any(record["shares"].get(label, 0.0) > 0 for label in USED)
        sigmas = self.sigmas.setdefault(camera, {})
        for label, sigma in record.get("sigmas", {}).items():
            if sigma is not None:
                sigmas.setdefault(label, []).append(sigma)
        if record["refused"]:
            self.refused.append((camera, frame, record["refused"]))

    def add_part(self, part: PriorSummary) -> None:
        """Take in the summary of another part of the same build; notes that both have are kept once."""
        self.built, self.kept = self.built + part.built, self.kept + part.kept
        for camera, share in part.shares.items():
            mean = self.shares.setdefault(camera, dict.fromkeys(share, 0.0))
            total = self._counts[camera] + part._counts[camera]
            for label, value in share.items():
                mean[label] += (value - mean[label]) * part._counts[camera] / total
            self._counts[camera] = total
        self._used.update(part._used)
        for camera, labels in part.sigmas.items():
            sigmas = self.sigmas.setdefault(camera, {})
            for label, values in labels.items():
                sigmas.setdefault(label, []).extend(values)
        self.refused = sorted([*self.refused, *part.refused], key=lambda refusal: refusal[1])
        self.folder = part.folder or self.folder
        self.notes += [note for note in part.notes if note not in self.notes]

    def sigma(self, camera: str, label: str) -> float | None:
        """Median over the frames of the median sigma of a label's pixels; None where it is infinite or paper's 0."""
        values = self.sigmas.get(camera, {}).get(label, [])
        return median(values) or None if values else None

    @property
    def usable(self) -> bool:
        """Whether any view has a pixel that the hooks can use."""
        return any(self._used.values())

    def reasons(self) -> str:
        """Why views were refused, each reason with their number; empty where none was."""
        counts = Counter(reason for _, _, reason in self.refused)
        return "; ".join(f"{count}x {reason}" for reason, count in counts.most_common())

    def headline(self) -> str:
        """The prior in one line: how many views have one, which cameras have none, and every reason of a refusal."""
        used, total = sum(self._used.values()), sum(self._counts.values())
        without = [camera for camera, count in self._counts.items() if count and not self._used[camera]]
        parts = [f"prior: {used} of {total} views are usable"]
        parts += [f"none of camera{'' if len(without) == 1 else 's'} {', '.join(without)}"] if without else []
        parts += [f"maps refused {self.reasons()}"] if self.refused else []
        return "; ".join(parts)

    def as_dict(self) -> dict[str, Any]:
        """For metrics.json: the same whether the priors were built now or before."""
        cameras = {
            camera: {
                "views": self._counts[camera],
                "usable": self._used[camera],
                "shares": dict(shares),
                "sigma": {label: self.sigma(camera, label) for label in DECLARED.values()},
            }
            for camera, shares in self.shares.items()
        }
        refused = [{"camera": camera, "frame": frame, "reason": reason} for camera, frame, reason in self.refused]
        return {"headline": self.headline(), "cameras": cameras, "refused": refused, "notes": list(self.notes)}

    def __str__(self) -> str:
        lines = [f"{self.built} priors built, {self.kept} kept", *self._share_lines(), *self._sigma_lines()]
        reasons = Counter(reason for _, _, reason in self.refused)
        for reason, count in reasons.most_common():
            examples = [f"{camera}/{frame}" for camera, frame, why in self.refused if why == reason][:3]
            lines.append(f"refused {count}x ({', '.join(examples)}{', ...' if count > 3 else ''}): {reason}")
        return "\n".join([*lines, *self.notes])

    def _share_lines(self) -> list[str]:
        lines = [f"{'camera':12}" + "  ".join(f"{name:>9}" for name in SHOWN)]
        for camera, share in self.shares.items():
            values = (share.get(label, 0.0) for label in SHOWN.values())
            lines.append(f"{camera:12}" + "  ".join(f"{value:9.1%}" for value in values))
        return lines

    def _sigma_lines(self) -> list[str]:
        """Median sigma per camera and label; nothing where no sigma was declared, as in the paper."""
        rows = {camera: [self.sigma(camera, label) for label in DECLARED.values()] for camera in self.shares}
        if all(value is None for values in rows.values() for value in values):
            return []
        lines = [f"{'sigma':12}" + "  ".join(f"{name:>9}" for name in DECLARED)]
        for camera, values in rows.items():
            shown = (f"{'-':>9}" if value is None else f"{value:9.2%}" for value in values)
            lines.append(f"{camera:12}" + "  ".join(shown))
        return lines
