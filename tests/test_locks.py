"""One writer at a time; the lock goes with the process that held it."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from d2_plugin.errors import D2Error
from d2_plugin.locks import Busy, in_turn, one_of_many, only_writer

HOLD = (
    "import sys, time; from pathlib import Path; from d2_plugin.locks import only_writer\n"
    "with only_writer(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"
)


def test_a_second_writer_is_refused_with_one_sentence_until_the_first_ends(tmp_path: Path) -> None:
    with only_writer(tmp_path), pytest.raises(Busy, match="another process is writing .*: wait until it has ended"):
        only_writer(tmp_path).__enter__()
    with only_writer(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == [], "a lock is no file"


def test_the_lock_of_a_killed_process_is_free(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    with pytest.raises(Busy):
        only_writer(tmp_path).__enter__()
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    with only_writer(tmp_path):
        pass


def test_many_may_write_beside_each_other_and_the_first_tidies(tmp_path: Path) -> None:
    tidied = []
    first, second = (one_of_many(tmp_path, lambda number=number: tidied.append(number)) for number in (1, 2))
    with first, second, pytest.raises(Busy):
        only_writer(tmp_path).__enter__()
    assert tidied == [1]


def test_turns_are_taken_one_after_the_other(tmp_path: Path) -> None:
    inside, most = [], []

    def turn() -> None:
        with in_turn(tmp_path):
            inside.append(1)
            most.append(len(inside))
            threading.Event().wait(0.01)
            inside.pop()

    threads = [threading.Thread(target=turn) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1] * 6


def test_a_folder_that_is_none_is_told(tmp_path: Path) -> None:
    with pytest.raises(D2Error, match="cannot open the folder"), only_writer(tmp_path / "absent"):
        pass
