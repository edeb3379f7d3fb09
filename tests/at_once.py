"""Runs of a comparison in this process: a worker of its own imports torch for seven seconds before it trains."""

import pickle
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from typing import Any

import pytest
import torch

from d2_plugin import progress
from d2_plugin.runs.training import measured


class AtOnce(Executor):
    """What is submitted travels as it would to a worker, and is done here."""

    def submit(self, work: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        work, arguments, named = pickle.loads(pickle.dumps((work, arguments, named)))
        future: Future[Any] = Future()
        future.set_result(work(*arguments, **named))
        return future


@contextmanager
def measured_at_once() -> Iterator[None]:
    """Measure every run of a comparison in this process, which stays as it was."""
    threads = torch.get_num_threads()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measured, "worker_pool", lambda count: AtOnce())
        patch.setattr(progress, "be_silent", lambda: None)
        yield
    torch.set_num_threads(threads)
