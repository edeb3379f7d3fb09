"""A published evaluation on N3DV by its name: cameras, size, frames and steps of its code, priors, runs, scores."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from d2_plugin.errors import D2Error, refuse_unknown
from d2_plugin.settings import AtATime, Count, Positional, Range, Seed, Settings
from d2_plugin.values import counted


@dataclass(frozen=True)
class ProtocolRun(Settings):
    """Which protocol, on what."""

    name: Annotated[str, Positional()]
    """gc-4dgs-2, gc-4dgs-3, gc-4dgs-4, 4c4d, or ours-2, ours-3, ours-4."""
    recording: Annotated[Path, Positional()]
    """Folder of a scene of N3DV, named after it."""
    output: Path = Path("protocol")
    """Folder of priors, runs and training.jsonl; what is missing in it is made."""
    methods: tuple[str, ...] = ("backbone", "full")
    """Rows or tables of `d2 ablate`."""
    seeds: tuple[Seed, ...] = (0,)
    """Seeds; a claim needs three."""
    iterations: Annotated[int, Range(1, unit="steps")] | None = None
    """Steps, where not those of the protocol."""
    frames: tuple[Count, ...] | None = None
    """Numbers of the frames, where not those of the protocol."""
    mono_onnx: str | None = None
    """ONNX model of monocular depth; the recording's own maps if not given."""
    mono_kind: Literal["relative", "metric"] | None = None
    """What the model returns."""
    jobs: AtATime = os.cpu_count() or 1
    """Runs at a time, one thread each."""


def run(settings: ProtocolRun) -> str:
    """Measure what is missing; the table, and what is otherwise than published."""
    from d2_plugin.recordings import open_recording
    from d2_plugin.recordings.presets import resolve_cameras
    from d2_plugin.runs.metrics import VARIANTS
    from d2_plugin.runs.protocols import PROTOCOLS, differences
    from d2_plugin.runs.report.quality import groups_of, scores_table
    from d2_plugin.runs.rows import read_rows
    from d2_plugin.runs.tables import COLUMNS, markdown
    from d2_plugin.runs.training import bench

    refuse_unknown("protocol", [settings.name], PROTOCOLS)
    protocol, path = PROTOCOLS[settings.name], str(settings.recording)
    if "@" in path:
        raise D2Error(f"{path} has an @ in its path, which parts a recording from its cameras: rename a folder")
    whole = open_recording(path, intersect=True)
    factor = max(round(whole.cameras[min(whole.cameras)].width / protocol.size[0]), 1)
    frames = settings.frames or whole.frames[: protocol.frames]
    iterations = settings.iterations or protocol.iterations
    train, test, _ = resolve_cameras(path, (protocol.cameras,))
    used = open_recording(path, frames=frames, downscale=factor, intersect=True)
    about = {
        "size": [used.cameras[train[0]].width, used.cameras[train[0]].height],
        "points": "triangulated features of the training cameras",
        "metrics": {name: VARIANTS[name] for name in protocol.metrics},
        "differs": list(differences(protocol, used, train, iterations)),
    }
    chosen = {
        name: getattr(settings, name) for name in ("methods", "seeds", "mono_onnx", "mono_kind", "jobs", "output")
    }
    of_bench = bench.TrainingBench(
        recordings=(f"{path}@{protocol.cameras}",), steps=(iterations,), frames=frames, downscale=factor, **chosen
    )
    where = bench.run(of_bench, name=f"protocol {settings.name}", about=about)
    rows = [row for row in read_rows([settings.output / "training.jsonl"]) if about.items() <= row.items()]
    columns = [column for column in COLUMNS if column.key in protocol.metrics]
    groups = groups_of(rows)
    without = [column.title for column in columns if not any(group.scores(column) for group in groups)]
    lines = [
        f"{settings.name}: trains on {', '.join(train)}, scores {', '.join(test or ())}; "
        f"{'x'.join(map(str, about['size']))} pixels, {counted(len(frames), 'frame')}, {counted(iterations, 'step')}",
        markdown(scores_table(groups, columns)),
        *(f"not as published: {line}" for line in about["differs"]),
        *([f"published and not measured here: {', '.join(without)}"] if without else []),
    ]
    return "\n".join([*lines, where])
