"""A disk that fails, kill -9 at any moment, a day of runs on one store: the same command again ends as undisturbed."""

import errno
import random
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from trust_commands import FAIL_FROM, FAIL_ONCE, KILL_AFTER_RENAME, KILL_BEFORE_RENAME, Fault, contents, killed

from d2_plugin.store.store import PriorStore

WORK = ("import", "priors", "train", "eval", "export", "page", "report")

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


@pytest.mark.parametrize(
    ("name", "how"), [("priors", KILL_BEFORE_RENAME), ("train", KILL_BEFORE_RENAME), ("export", KILL_AFTER_RENAME)]
)
def test_a_command_that_is_killed_at_a_rename_goes_on_to_the_same_end(workplace: Any, name: str, how: int) -> None:
    is_killed_and_goes_on(workplace, name, workplace.renames[name] // 2, how)


def test_a_disk_on_which_nothing_can_be_written_is_told_before_anything_else(workplace: Any) -> None:
    for name in ("priors", "train"):
        work = workplace.work[name]
        work.anew()
        ended = workplace.commands.run(work.words, Fault(work.folder, FAIL_FROM, 0, errno.EROFS))
        assert "Read-only file system" in ended.refusal
        assert "choose a folder that you may write" in ended.refusal


def test_a_run_that_cannot_be_written_is_not_scored_first(workplace: Any) -> None:
    work = workplace.work["eval"]
    work.anew()
    ended = workplace.commands.run([*work.words, "--no-images"], Fault(work.folder, FAIL_FROM, 0, errno.EROFS))
    assert ended.refusal.startswith(f"d2: cannot write {work.output} (Read-only file system): make it writable or ")


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


@pytest.mark.slow
@pytest.mark.parametrize("name", WORK)
def test_twenty_kills_at_random_moments(workplace: Any, name: str) -> None:
    """Up to three in a row, at moments drawn from its CPU time, before it is run to its end."""
    draw, work, hits, ends = random.Random(f"{name} 20"), workplace.work[name], 0, 0
    while hits < 20 and ends < 60:
        work.anew()
        for _ in range(draw.choice((1, 1, 2, 3))):
            hits += killed(workplace.commands.run(work.words, kill_after=draw.uniform(0, workplace.cpu[name])))
        goes_on(workplace, name)
        ends += 1
    assert hits >= 20


def is_whole(place: Any, store: Path) -> None:
    """The store holds what an undisturbed build leaves."""
    mine = contents(PriorStore.located(store, ["train0", "train1"]))  # another camera's may have been first
    whole = {name: content for name, content in place.whole["priors"].items() if not name.endswith(".png")}
    assert {name: mine.get(name) for name in whole} == whole
    assert not list(store.rglob(".*.part"))


def test_builds_of_one_store_and_runs_on_it_side_by_side_are_whole_and_alike(workplace: Any) -> None:
    """The runs have one seed: what one of them leaves, the other leaves."""
    shared = workplace.folder / "shared"
    priors = str(shared / "priors")
    runs = [str(shared / name) for name in ("one", "two")]
    build = [*workplace.work["priors"].words, "--output", priors]
    train = [*workplace.work["train"].words, "--priors", priors, "--output"]
    for commands in ([build, build], [[*train, run] for run in runs]):
        started = [workplace.commands.start(words) for words in commands]
        for ended in [one.end() for one in started]:
            assert ended.code == 0, ended.said
    is_whole(workplace, shared / "priors")
    one, two = (contents(Path(run)) for run in runs)
    assert "metrics.json" in one
    assert one == two


SEEDS = 200


def a_run(place: Any, seed: int) -> list[str]:
    """Of the runs that differ by their seed, all on one store; the last of two flags counts."""
    folder = place.folder / "day"
    own = ["--iterations", "3", "--seed", str(seed), "--priors", str(folder / "priors")]
    return [*place.work["train"].words, *own, "--output", str(folder / f"run{seed}")]


def goes_on_until_none_is_left(place: Any, store: Path, left: set[int], draw: random.Random) -> int:
    """Start runs, of which some are killed, and some are started twice, until all have scores; returns the kills.

    Now and then it is a build of the priors that they share, or of fewer cameras."""
    kills = 0
    while seeds := sorted(left):
        seed, chance = draw.choice(seeds), draw.random()
        words = a_run(place, seed)
        if chance < 0.1 or not (store / "store.json").is_file():
            cameras = "train0,train1" if chance > 0.05 else "train1"
            words = [*place.work["priors"].words, "--train-cameras", cameras, "--output", str(store)]
        limit = None if draw.random() < 0.6 else draw.uniform(0, place.cpu["train"])
        ended = place.commands.run(words, kill_after=limit)
        kills += killed(ended)
        if ended.code == 2:
            assert "another process is writing" in ended.refusal, ended.said
        elif not killed(ended):
            assert ended.code == 0, ended.said
            if "PSNR" in ended.said:
                left.discard(seed)
    return kills


@pytest.mark.slow
def test_two_hundred_runs_started_killed_and_continued_by_three_processes(workplace: Any) -> None:
    folder, left = workplace.folder / "day", set(range(SEEDS))
    store = folder / "priors"
    with ThreadPoolExecutor(3) as threads:
        draws = [random.Random(f"{SEEDS} {number}") for number in range(3)]
        kills = sum(threads.map(lambda draw: goes_on_until_none_is_left(workplace, store, left, draw), draws))
    assert kills > SEEDS // 5
    is_whole(workplace, store)
    for built in [store, *(store / "cameras").glob("*")]:
        opened = PriorStore.open(built)
        for camera in opened.cameras:
            for frame in opened.frames:
                opened.prior(camera, frame)  # compares every checksum
    assert all((folder / f"run{seed}" / "metrics.json").is_file() for seed in range(SEEDS))
    for seed in random.Random(SEEDS).sample(range(SEEDS), SEEDS // 10):
        found = contents(folder / f"run{seed}")
        shutil.rmtree(folder / f"run{seed}")
        ended = workplace.commands.run(a_run(workplace, seed))
        assert ended.code == 0, ended.said
        assert found == contents(folder / f"run{seed}")
