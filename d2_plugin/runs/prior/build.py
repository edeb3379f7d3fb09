"""The depth prior of a run: what its settings and its scene make of the prior builder's arguments."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.priors.between import build_between
from d2_plugin.priors.build import PriorSummary, build_priors
from d2_plugin.progress import Bar, progress_bar
from d2_plugin.runs.scene import Scene
from d2_plugin.store.store import PriorStore


def build_priors_for(
    scene: Scene,
    points: np.ndarray,
    folder: Path,
    *,
    shard: tuple[int, int] | None = None,
    cluster: Mapping[str, Any] | None = None,
    between: bool = True,
    on_view: Callable[[], None] = lambda: None,
) -> PriorSummary:
    """Build what is missing of the depth prior in `folder`; `points` [P, 3] bound the depths that are searched.

    `shard` (index from 0, count) builds one part, so that any scheduler can run the parts beside each other. `cluster`
    (`scheduler` or `workers`) hands the frames to dask.distributed instead. `between` makes the instants between the
    frames as well, for the hook `motion`. `on_view` is called after each finished view, or part of a cluster's work.
    """

    settings = scene.prior_settings
    between = between and settings.between and scene.plan.uses("temporal") and shard is None
    network = None
    if between and settings.flow_onnx is not None:
        from d2_plugin.priors.flow_network import FlowNetwork  # needs an extra

        network = FlowNetwork(settings.flow_onnx, settings.flow_range, settings.mono_threads)

    def report(bar: Bar, done: int, total: int = 0, note: str = "") -> None:
        bar.update(done, note)
        on_view()

    with progress_bar("priors", len(scene.recording.frames) * len(scene.train_cameras)) as bar:
        if cluster is None:
            build = partial(build_priors, shard=shard)
        else:
            from d2_plugin.priors.dask_build import build_priors_on_cluster  # needs an extra

            build = partial(build_priors_on_cluster, **cluster)
        given = scene.recording, scene.train_cameras, folder, settings
        summary = build(*given, sparse_points=points, progress=partial(report, bar))
    if between:
        store = PriorStore.described(PriorStore.located(folder, scene.train_cameras))
        with progress_bar("between", len(store.cameras) * (len(store.frames) - 1)) as bar:
            build_between(store, partial(report, bar), network)
    return summary


def refuse_unusable(summary: PriorSummary, accepted: bool) -> None:
    """Refuse to train with hooks that have nothing to go by, unless the settings ask for it."""
    if summary.usable or accepted:
        return
    raise D2Error(
        f"no view has a usable prior ({summary.reasons() or 'no depth anywhere'}): look at the depth maps and the "
        "calibration with `d2 priors`, or train without it by --hooks none, or with it as it is by --accept-empty-prior"
    )
