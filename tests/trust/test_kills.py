"""kill -9 at any moment: the same command again ends bitwise as the uninterrupted one."""

from __future__ import annotations

import logging
import random
from typing import Any

import pytest
from trust_commands import contents, killed

WORK = ("priors", "train", "eval", "export", "page", "report")


def killed_at_random(place: Any, name: str, draw: random.Random, times: int) -> int:
    """Kill the command at random moments, so many times in all; returns how many kills came before its end."""
    work, hits = place.work[name], 0
    for _ in range(times):
        if hits == 0 or draw.random() < 0.5:  # else it goes on from where it was killed, and is killed again
            work.anew()
        hits += killed(place.commands.kill_after(work.words, draw.uniform(0, place.seconds[name])))
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
    draw, hits, tries = random.Random(f"{name} 20"), 0, 0
    while hits < 20 and tries < 200:  # one that came after the end, as on a machine that is quicker now, is no kill
        hits, tries = hits + killed_at_random(workplace, name, draw, 1), tries + 1
    logging.getLogger(__name__).info("%s: 20 kills in %d tries", name, tries)
    assert hits >= 20
