"""A disk that fails, kill -9 at any moment: nothing is lost, and the same command again ends bitwise as undisturbed."""

from __future__ import annotations

import errno
import logging
import random
from typing import Any

import pytest
from trust_commands import FAIL_FROM, FAIL_ONCE, KILL_AFTER_RENAME, KILL_BEFORE_RENAME, Fault, contents, killed

WORK = ("import", "priors", "train", "eval", "export", "page", "report")
KILLS = 20
ERRORS = {errno.ENOSPC: "No space left on device", errno.EIO: "Input/output error"}


def fails_and_goes_on(place: Any, name: str, at: int, error: int) -> None:
    """The operation of that number fails once; then the same command is given again."""
    work = place.work[name]
    work.anew()
    refusal = place.commands.run(work.words, Fault(work.folder, FAIL_ONCE, at, error)).refusal
    assert refusal.startswith("d2: cannot write "), refusal
    assert ERRORS[error] in refusal
    goes_on(place, name)


def is_killed_and_goes_on(place: Any, name: str, at: int, how: int) -> None:
    """The process is killed before or after the rename of that number; then the same command is given again."""
    work = place.work[name]
    work.anew()
    assert killed(place.commands.run(work.words, Fault(work.folder, how, at)))
    goes_on(place, name)


def goes_on(place: Any, name: str) -> None:
    """The command, given again, leaves what the uninterrupted one left."""
    work = place.work[name]
    ended = place.commands.run(work.words)
    already = "already exists and is not empty" in ended.said  # an export that was whole before the kill
    assert ended.code == 0 or already, ended.said
    assert contents(work.folder) == {f"out/{path}": content for path, content in place.whole[name].items()}


@pytest.mark.parametrize("name", WORK)
def test_a_write_that_fails_is_one_sentence_and_loses_nothing(workplace: Any, name: str) -> None:
    share, error = (0.35, errno.ENOSPC) if name in ("priors", "eval") else (0.7, errno.EIO)
    fails_and_goes_on(workplace, name, int(share * workplace.operations[name]), error)


@pytest.mark.parametrize("name", ["train", "export"])
def test_a_kill_at_a_rename_loses_nothing(workplace: Any, name: str) -> None:
    is_killed_and_goes_on(workplace, name, workplace.renames[name] // 2, KILL_AFTER_RENAME)


def test_a_disk_on_which_nothing_can_be_written_is_told_before_anything_else(workplace: Any) -> None:
    for name in ("priors", "train"):
        work = workplace.work[name]
        work.anew()
        ended = workplace.commands.run(work.words, Fault(work.folder, FAIL_FROM, 0, errno.EROFS))
        assert "Read-only file system" in ended.refusal
        assert "choose a folder that you may write" in ended.refusal


def test_a_finished_prior_is_used_where_nothing_can_be_written(workplace: Any) -> None:
    priors = workplace.folder / "priors"
    before = contents(priors)
    run = workplace.folder / "reader"
    words = [*workplace.work["train"].words[:-1], str(run)]
    ended = workplace.commands.run(words, Fault(priors, FAIL_FROM, 0, errno.EROFS))
    assert ended.code == 0, ended.said
    again = [*workplace.work["priors"].words[:-1], str(priors)]
    ended = workplace.commands.run(again, Fault(priors, FAIL_FROM, 0, errno.EROFS))
    assert ended.code == 0, ended.said
    assert "all was there already; cannot write" in ended.said
    assert contents(priors) == before


@pytest.mark.slow
@pytest.mark.parametrize("name", WORK)
def test_every_write_may_fail_once(workplace: Any, name: str) -> None:
    for at in range(workplace.operations[name]):
        fails_and_goes_on(workplace, name, at, errno.EIO if at % 2 else errno.ENOSPC)


@pytest.mark.slow
@pytest.mark.parametrize("name", WORK)
def test_every_rename_may_be_the_last_thing_that_happens(workplace: Any, name: str) -> None:
    for at in range(workplace.renames[name]):
        is_killed_and_goes_on(workplace, name, at, KILL_BEFORE_RENAME if at % 2 else KILL_AFTER_RENAME)


def killed_at_random(place: Any, name: str, draw: random.Random, times: int) -> int:
    """Kill the command at moments drawn from its CPU time, so many times in a row; then it is run to its end."""
    work, hits = place.work[name], 0
    work.anew()
    for _ in range(times):
        hits += killed(place.commands.kill_after(work.words, draw.uniform(0, place.cpu[name])))
    goes_on(place, name)
    return hits


@pytest.mark.parametrize("name", ["priors", "train", "export"])
def test_a_killed_command_goes_on_to_the_same_end(workplace: Any, name: str) -> None:
    killed_at_random(workplace, name, random.Random(f"{name} 1"), 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", WORK)
def test_twenty_kills_at_random_moments(workplace: Any, name: str) -> None:
    draw, hits, ends = random.Random(f"{name} 20"), 0, 0
    while hits < KILLS and ends < 3 * KILLS:
        hits, ends = hits + killed_at_random(workplace, name, draw, draw.choice((1, 1, 2, 3))), ends + 1
    logging.getLogger(__name__).info("%s: %d kills, %d times to the same end", name, hits, ends)
    assert hits >= KILLS
