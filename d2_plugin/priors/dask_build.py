"""Priors built by dask.distributed: its workers run the parts that `build_priors(shard=...)` builds.

Workers are processes of this machine, or machines of a cluster that share a file system. Each writes finished frames
into the one store, so nothing but the summary travels back. A worker that dies loses the frame it was building; its
part is started again elsewhere and finds there what was finished.
"""

from __future__ import annotations

import logging
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.extras import imported
from d2_plugin.priors.build import Progress, build_priors
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.priors.stereo.matched_depth import frame_blocks
from d2_plugin.priors.summary import PriorSummary
from d2_plugin.recordings.recording import Recording
from d2_plugin.values import counted

PARTS_PER_WORKER = 4
"""Parts are handed out as workers become free. More parts even out frames that take longer; each part loads the
monocular network once."""

logger = logging.getLogger(__name__)


def build_priors_on_cluster(
    recording: Recording,
    cameras: Sequence[str],
    output: Path | str,
    settings: PriorSettings,
    *,
    scheduler: str | None = None,
    workers: int = 2,
    sparse_points: np.ndarray | None = None,
    progress: Progress = lambda done, total, note: None,
) -> PriorSummary:
    """`build_priors`, on many machines or on several processes of this one; the store is the same, byte for byte.

    Started from a script of your own, local workers import that script: put the call under
    `if __name__ == "__main__":`.

    Args:
        recording: the recording, whose files every worker can read under the same paths.
        cameras, output, settings, sparse_points: as for `build_priors`; `output` must be the same folder for everyone.
        scheduler: address of a dask scheduler, as `tcp://host:8786`; workers on this machine where None.
        workers: most processes on this machine, where there is no scheduler; no more than there are parts.
        progress: called after every part, with images done and in all.

    Raises:
        D2Error: what `build_priors` refuses, no scheduler or no worker at the address, or a part whose workers died
            again and again.
        MissingExtra: dask.distributed is not installed.
    """
    folder = Path(output).absolute()
    if recording.path is not None:
        recording = replace(recording, path=recording.path.absolute())
    blocks = len(frame_blocks(recording.frames, settings.stereo))  # parts are whole blocks: frames in one have an order
    with cluster_client(scheduler, min(workers, blocks)) as client, client.as_current():
        count = min(blocks, PARTS_PER_WORKER * max(len(client.nthreads()), 1))
        shared = {"sparse_points": None if sparse_points is None else np.asarray(sparse_points), "pure": False}
        parts = [
            client.submit(build_priors, recording, list(cameras), folder, settings, shard=(index, count), **shared)
            for index in range(count)
        ]
        return _joined(parts, len(recording.frames) * len(cameras), progress)


def _joined(parts: list[Any], total: int, progress: Progress) -> PriorSummary:
    """The summary of all parts, in the order in which they end; the first error ends all of them."""
    from distributed import KilledWorker, as_completed

    summary, done = PriorSummary(), 0
    for future in as_completed(parts):
        try:
            part: PriorSummary = future.result()
        except KilledWorker as error:
            raise D2Error(
                f"a part of the priors killed {error.allowed_failures + 1} workers: look into their logs (mostly "
                "it is memory), then build again, which keeps what is finished"
            ) from None
        summary.add_part(part)
        done += part.built + part.kept
        progress(done, total, f"a part of {counted(part.built + part.kept, 'image')}")
    return summary


@contextmanager
def cluster_client(scheduler: str | None, workers: int, purpose: str = "building priors on a cluster") -> Iterator[Any]:
    """A client of the scheduler at that address, or of processes that are started here and ended afterwards.

    `purpose` completes the sentence "<purpose> needs dask.distributed".
    """
    distributed = imported("distributed", "dask.distributed", "cluster", purpose)
    if scheduler is not None:
        try:
            # A client asks in vain for ten seconds whatever the address is, and then ends its process slowly.
            host, port = distributed.comm.get_address_host_port(scheduler)
            if not 0 < port < 1 << 16:
                raise ValueError("ports are 1 to 65535")
            socket.getaddrinfo(host, port)
            certificates = distributed.Security().get_connection_args("client")["ssl_context"]
            if scheduler.startswith("tls://") and certificates is None:
                raise ValueError("TLS needs distributed.comm.tls in dask's configuration")
            client = distributed.Client(scheduler, timeout="10s", set_as_default=False)
        except (OSError, TypeError, ValueError) as error:
            raise D2Error(
                f"no dask scheduler answers at {scheduler} ({error}): start one with `dask scheduler`, or leave the "
                "address out for workers on this machine"
            ) from None
        with client:
            if not client.nthreads():
                raise D2Error(f"the scheduler at {scheduler} has no worker: start some with `dask worker {scheduler}`")
            yield client
        return
    if workers < 1:
        raise D2Error(f"{workers} workers cannot build anything: give at least 1")
    with (
        distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,  # frames are independent: processes of one thread waste nothing
            processes=True,
            dashboard_address=":0",
            silence_logs=logging.ERROR,
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client
