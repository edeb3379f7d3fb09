"""kill -9 at any moment: the same command again ends bitwise as the uninterrupted one."""

from __future__ import annotations

import logging
import random
from typing import Any

import pytest
from trust_commands import contents, killed

WORK = ("import", "priors", "train", "eval", "export", "page", "report")
KILLS = 20


def killed_at_random(place: Any, name: str, draw: random.Random, times: int) -> int:
    """Kill the command at moments drawn from its CPU time, so many times in a row; then it is run to its end.

    Returns how many kills came before its end: what was killed before has less left to do.
    """
    work, hits = place.work[name], 0
    work.anew()
    for _ in range(times):
        hits += killed(place.commands.kill_after(work.words, draw.uniform(0, place.cpu[name])))
    ended = place.commands.run(work.words)
    already = "already exists and is not empty" in ended.said  # an export that was whole before the kill
    assert ended.code == 0 or already, ended.said
    assert contents(work.folder) == {f"out/{path}": content for path, content in place.whole[name].items()}
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
