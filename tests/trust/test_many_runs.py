"""A day of use in small: three processes start, kill and continue runs on one store; all of it stays whole."""

from __future__ import annotations

import logging
import random
import shutil
import time
from pathlib import Path
from typing import Any

import pytest
from trust_commands import Ended, Started, contents, killed

from d2_plugin.store.store import PriorStore

SEEDS = 200
AT_ONCE = 3


class Day:
    """Runs that differ by their seed, all on one store, of which some are killed, and some are started twice."""

    def __init__(self, place: Any, runs: int, draw: random.Random) -> None:
        self.place, self.draw = place, draw
        self.folder = place.folder / f"day{runs}"
        shutil.rmtree(self.folder, ignore_errors=True)
        self.store = self.folder / "priors"
        self.open = set(range(runs))
        self.kills = self.refusals = self.builds = 0

    def words(self, seed: int) -> list[str]:
        train = self.place.work["train"].words
        before = train[: train.index("--iterations")]
        own = ["--iterations", "3", "--seed", str(seed), "--priors", str(self.store)]
        return [*before, *own, "--output", str(self.folder / f"run{seed}")]

    def live(self) -> None:
        """Until every run is finished."""
        running: dict[Started, int] = {}
        while self.open or running:
            while len(running) < AT_ONCE and (self.open or not running):
                seed = self.draw.choice(sorted(self.open))
                limit = None if self.draw.random() < 0.6 else self.draw.uniform(0, self.place.cpu["train"])
                running[self.place.commands.start(self._next(seed), kill_after=limit)] = seed
            time.sleep(0.02)
            for started, seed in list(running.items()):
                if not started.process.is_alive():
                    del running[started]
                    self._ended(seed, started.end())

    def _next(self, seed: int) -> list[str]:
        """Mostly a run; now and then a build of the priors that it shares with the others, or of fewer cameras."""
        chance = self.draw.random()
        if chance > 0.1 and (self.store / "store.json").is_file():
            return self.words(seed)
        self.builds += 1
        cameras = "train0,train1" if chance > 0.05 else "train1"
        words = [word if word != "train0,train1" else cameras for word in self.place.work["priors"].words[:-1]]
        return [*words, str(self.store)]

    def _ended(self, seed: int, ended: Ended) -> None:
        if killed(ended):
            self.kills += 1
        elif ended.code == 2:
            assert "another process is writing" in ended.refusal, ended.said
            self.refusals += 1
        else:
            assert ended.code == 0, ended.said
            if "PSNR" in ended.said:
                self.open.discard(seed)


def whole(place: Any, folder: Path, words: list[str]) -> dict[str, Any]:
    """What a run leaves that nobody disturbs, in the same folder."""
    found = contents(folder)
    shutil.rmtree(folder)
    ended = place.commands.run(words)
    assert ended.code == 0, ended.said
    alone = contents(folder)
    assert found == alone
    return alone


def lives_through(place: Any, runs: int, checked: int) -> Day:
    day = Day(place, runs, random.Random(runs))
    day.live()
    mine = contents(PriorStore.located(day.store, ["train0", "train1"]))  # the other camera's may have been first
    whole_store = {name: content for name, content in place.whole["priors"].items() if not name.endswith(".png")}
    assert {name: mine.get(name) for name in whole_store} == whole_store
    for folder in [day.store, *(day.store / "cameras").glob("*")]:
        store = PriorStore.open(folder)
        for camera in store.cameras:
            for frame in store.frames:
                store.prior(camera, frame)  # compares every checksum
    for seed in day.draw.sample(range(runs), checked):
        whole(place, day.folder / f"run{seed}", day.words(seed))
    for seed in range(runs):
        assert (day.folder / f"run{seed}" / "metrics.json").is_file()
    assert not list(day.folder.rglob(".*.part"))
    return day


def test_a_few_runs_side_by_side_are_all_whole(workplace: Any) -> None:
    lives_through(workplace, 2, 1)


@pytest.mark.slow
def test_two_hundred_runs_started_killed_and_continued_by_three_processes(workplace: Any) -> None:
    day = lives_through(workplace, SEEDS, 20)
    told = (day.kills, day.refusals, day.builds)
    logging.getLogger(__name__).info("%d kills, %d second writers refused, %d builds beside the runs", *told)
    assert day.kills > SEEDS // 5
