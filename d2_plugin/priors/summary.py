"""What a build of priors did, as a person reads it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

SHOWN = {"verified": "verified", "agreed": "agreed", "mono only": "mono", "conflict": "conflict", "empty": "empty"}
"""Columns of the summary, and the share each shows."""


@dataclass
class PriorSummary:
    """What a build did: mean shares of the labels per camera, refused views and why, notes on what was left out."""

    built: int = 0
    kept: int = 0
    shares: dict[str, dict[str, float]] = field(default_factory=dict)
    refused: list[tuple[str, int, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    _counts: Counter[str] = field(default_factory=Counter)

    def add(self, camera: str, frame: int, record: dict[str, Any], built: bool) -> None:
        """Take one view's record into account."""
        self.built, self.kept = self.built + built, self.kept + (not built)
        count = self._counts[camera]
        mean = self.shares.setdefault(camera, dict.fromkeys(record["shares"], 0.0))
        for label, share in record["shares"].items():
            mean[label] += (share - mean[label]) / (count + 1)
        self._counts[camera] += 1
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
        self.refused = sorted([*self.refused, *part.refused], key=lambda refusal: refusal[1])
        self.notes += [note for note in part.notes if note not in self.notes]

    def __str__(self) -> str:
        lines = [
            f"{self.built} priors built, {self.kept} kept",
            f"{'camera':12}" + "  ".join(f"{name:>9}" for name in SHOWN),
        ]
        for camera, share in self.shares.items():
            values = (share[label] for label in SHOWN.values())
            lines.append(f"{camera:12}" + "  ".join(f"{value:9.1%}" for value in values))
        reasons = Counter(reason for _, _, reason in self.refused)
        for reason, count in reasons.most_common():
            examples = [f"{camera}/{frame}" for camera, frame, why in self.refused if why == reason][:3]
            lines.append(f"refused {count}x ({', '.join(examples)}{', ...' if count > 3 else ''}): {reason}")
        return "\n".join([*lines, *self.notes])
