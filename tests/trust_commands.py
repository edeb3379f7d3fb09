"""`d2` commands in processes of their own that can be killed, and whose disk can be made to fail."""

from __future__ import annotations

import ctypes
import hashlib
import itertools
import json
import multiprocessing
import os
import re
import signal
import sys
import time
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import pytest
import torch
from fuzzing import leaves

COUNT, FAIL_ONCE, FAIL_FROM, KILL_BEFORE_RENAME, KILL_AFTER_RENAME = range(5)
PRELOADED = [
    *("torch", "torch._dynamo", "torch.onnx", "sympy", "cv2", "pycolmap"),
    *("d2_plugin.commands.cli", "d2_plugin.runs.run", "d2_plugin.runs.evaluation", "d2_plugin.priors.build"),
    *("d2_plugin.backbones.yang4d", "d2_plugin.adapters.yang4d", "d2_plugin.commands.export_recording"),
    *("d2_plugin.runs.report.report", "d2_plugin.viewing.export.export", "d2_plugin.recordings.importing.importing"),
    *("av", "trust_commands"),
]
"""What the commands import, some of it late."""


@dataclass(frozen=True)
class Fault:
    """What goes wrong with files below a folder: at the operation or rename of this number, with this error."""

    folder: Path
    how: int = COUNT
    at: int = 0
    error: int = 0


@dataclass(frozen=True)
class Ended:
    code: int | None
    said: str
    operations: int = 0
    renames: int = 0
    cpu: float = 0.0
    """Seconds of CPU time, where a fault was given."""

    @property
    def refusal(self) -> str:
        """The one sentence of a command that was refused; fails where it ended in any other way."""
        assert self.code == 2, f"exit code {self.code}:\n{self.said[-2000:]}"
        assert "Traceback" not in self.said, self.said
        told = [line for line in self.said.splitlines() if line.startswith("d2: ")]
        assert len(told) == 1, self.said
        return told[0]


class Commands:
    """Starts commands, into which the library made of faults.c is loaded first."""

    def __init__(self, library: Path, logs: Path) -> None:
        self.logs, self._numbers = logs, itertools.count()
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(PRELOADED)
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("OMP_NUM_THREADS", "1")
            patch.setenv("LD_PRELOAD", str(library))
            first = self._context.Process(target=os.getpid)  # starts the process that the others are forked from
            first.start()
            first.join()

    def start(self, words: list[str], fault: Fault | None = None, kill_after: float | None = None) -> Started:
        """A command that runs while this one goes on; it is killed (SIGKILL) after so many CPU seconds."""
        log = self.logs / f"{os.getpid()}-{next(self._numbers)}.log"
        process = self._context.Process(target=_command, args=(words, str(log), fault, kill_after))
        process.start()
        return Started(process, log)

    def run(self, words: list[str], fault: Fault | None = None, kill_after: float | None = None) -> Ended:
        return self.start(words, fault, kill_after).end()


@dataclass(frozen=True)
class Started:
    process: BaseProcess
    log: Path

    def end(self) -> Ended:
        """Wait for it; one that takes more than five minutes is killed and reported."""
        self.process.join(300)
        if self.process.is_alive():
            self.process.kill()
            raise AssertionError(f"did not end within 300 s: {self.log.read_text()[-2000:]}")
        said = self.log.read_text(errors="replace") if self.log.exists() else ""
        counted = re.search(r"^counted (\d+) (\d+) (\S+)$", said, re.MULTILINE)
        operations, renames, cpu = counted.groups() if counted else (0, 0, 0)
        return Ended(self.process.exitcode, said, int(operations), int(renames), float(cpu))


def killed(ended: Ended) -> bool:
    return ended.code == -signal.SIGKILL


def _command(words: list[str], log: str, fault: Fault | None, kill_after: float | None) -> None:
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
    torch.set_num_threads(1)
    from d2_plugin.commands.cli import main
    from d2_plugin.progress import be_silent

    be_silent()
    shim = ctypes.CDLL(None)
    if fault is not None:
        numbers = ctypes.c_int(fault.how), ctypes.c_long(fault.at), ctypes.c_int(fault.error)
        shim.d2_fault_arm(str(fault.folder).encode(), *numbers)
    if kill_after is not None:
        assert shim.d2_fault_kill_after(ctypes.c_double(kill_after)) == 0
    code = main(words)
    if fault is not None:
        counted = f"{shim.d2_fault_operations()} {shim.d2_fault_renames()} {time.process_time():.3f}"
        sys.stderr.write(f"counted {counted}\n")
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def contents(folder: Path) -> dict[str, Any]:
    """Everything below a folder by relative name, without what tells the time: hashes of files, and tables and
    checkpoints without seconds and circumstances."""
    return {str(path.relative_to(folder)): _content(path) for path in folder.rglob("*") if not path.is_dir()}


def _content(path: Path) -> Any:
    if path.is_symlink():
        return f"link to {os.readlink(path)}"
    if path.name in ("metrics.json", "trials.json"):
        table = json.loads(path.read_text())
        return {name: value for name, value in table.items() if name not in ("seconds", "cpu_seconds", "made", "seal")}
    if path.name == "checkpoint.pt":
        state = torch.load(path, weights_only=True)
        del state["seconds"], state["cpu_seconds"]
        return leaves(state)
    return hashlib.sha256(path.read_bytes()).hexdigest()
