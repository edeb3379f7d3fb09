"""Command lines and configurations at random: an answer, or one sentence that is no fault of ours."""

import functools
import importlib.metadata
import os
import random
import string
from pathlib import Path

import pytest
from command_lines import form_of
from fuzzing import ODD_TEXTS, ODD_VALUES, SEED, bounded_memory, mutate_file

from d2_plugin.commands.arguments.text import flag_of
from d2_plugin.commands.cli import COMMANDS, main
from d2_plugin.config import for_iterations

ROUNDS = [(60, 0), pytest.param(2000, SEED, marks=pytest.mark.slow)]


def mistyped(words: list[str], rng: random.Random) -> list[str]:
    """A command line that a person might have meant, with one or two words removed, replaced, changed or repeated."""
    words = words.copy()
    for _ in range(rng.choice((1, 1, 2))):
        place = rng.randrange(len(words))
        match rng.randrange(4):
            case 0:
                del words[place]
            case 1:
                words[place] = odd_word(rng)
            case 2:
                letters = list(words[place])
                letters[rng.randrange(len(letters) or 1) : 1] = [rng.choice(string.printable)]
                words[place] = "".join(letters)
            case _:
                words.insert(place, rng.choice(words))
    return words


def expect_an_answer(words: list[str], capsys: pytest.CaptureFixture[str], seed: object) -> None:
    """Exit code 0, or 2 with one sentence that is no fault of ours."""
    code = main(words)
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if line.startswith("d2: ")]
    assert code in (0, 2), (seed, words)
    assert "unexpected" not in captured.err, (seed, words, captured.err)
    assert "Traceback" not in captured.err, (seed, words, captured.err)
    assert len(lines) == (1 if code else 0), (seed, words, captured.err)


@pytest.mark.parametrize(("count", "seed"), ROUNDS)
def test_configurations_at_random(small: Path, tmp_path: Path, capsys, count: int, seed: int) -> None:
    path = tmp_path / "d2.toml"
    tables = for_iterations(("densify", "prune", "depth_loss"), 100).to_toml().splitlines()
    whole = "\n".join(
        line for line in tables if line.startswith(("[", "spacing", "tau", "lambda", "every", "scale", "weight"))
    )
    whole += "\n[plan]\ntemporal = true\n[priors]\ndepth_range = [1.0, 9.0]\n[priors.stereo]\nmin_angle = 1.0\n"
    whole += "[backbone]\nsh_degree = 1\n[d2]\nretire_after = 3\n"
    words = ["plan", str(small), "--train-cameras", "cam00,cam01", "--config", str(path)]
    path.write_text(whole)
    assert main(words) == 0, capsys.readouterr().err
    with bounded_memory():
        for number in range(count):
            path.write_text(whole)
            mutate_file(path, random.Random(f"configuration {seed} {number}"))
            expect_an_answer(words, capsys, f"configuration {seed} {number}")


VARIABLES = ("D2_CACHE", "D2_CXXFLAGS", "CXX", "XDG_CACHE_HOME", "HOME", "TMPDIR", "COLUMNS", "TERM", "NO_COLOR")
"""What the commands read of the environment."""


def every_flag() -> list[tuple[str, str]]:
    """Each command with each of its flags, those of tables and of both backbones included."""
    found: set[tuple[str, str]] = set()
    for name in COMMANDS:
        for more in ([], ["--backbone", "deform"], ["--calibration", "x"]):
            words = ["training", *more] if name == "bench" else more
            form = form_of(name, words)
            names = [s.name for s in form.settings if not s.positional]
            names += [f"{section.name}.{s.name}" for section in form.sections(words).values() for s in section.settings]
            found |= {(name, flag_of(one)) for one in names if one != "output"}  # what can be written is written
    return sorted(found)


def odd_word(rng: random.Random) -> str:
    """What somebody may write who means harm, or mistypes."""
    numbers = ("1" + "0" * 25, "1e25", "1e-320", "-1e-320", "2000000000", "1e9,1e9", "0:10:-1", "1:", ":")
    places = ("/dev/null", "/dev/zero", "/proc/self/mem", "~nobody/x", "loop", "file", ".", "x" * 300, "pipe")
    return rng.choice((*map(str, ODD_VALUES), *ODD_TEXTS, *numbers, *places)).replace("\0", "")


@pytest.fixture(autouse=True)
def installed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """`d2 doctor` looks through all installed packages once for each that it names."""
    looked = functools.cache(importlib.metadata.packages_distributions)
    monkeypatch.setattr(importlib.metadata, "packages_distributions", looked)


AT_WORK = ("demo", "bench", "doctor", "ablate")
"""Commands that would begin to work if a word of theirs were another."""


@pytest.mark.parametrize(("count", "seed"), ROUNDS)
def test_odd_flags_and_command_lines_at_random(small: Path, tmp_path: Path, capsys, monkeypatch, count, seed) -> None:
    """Every flag of every command with odd values, each second one mistyped as well; no output can be written, and
    nothing is there to be shown."""
    monkeypatch.chdir(tmp_path)
    flags = every_flag()
    (tmp_path / "file").write_text("in the way of every output")
    (tmp_path / "loop").symlink_to("loop")
    os.mkfifo(tmp_path / "pipe")
    assert len(flags) > 300
    with bounded_memory():
        for number in range(2 * count):
            rng = random.Random(f"flags {seed} {number}")
            name, flag = rng.choice(flags)
            first = {"demo": [], "bench": ["training", "nowhere@a+b"], "view": ["nowhere"]}
            words = [name, *first.get(name, [str(small)])]
            words += ["--train-cameras", "cam00,cam01"] if name in ("train", "plan", "priors", "ablate") else []
            words += [] if name in ("plan", "eval", "view", "compare", "doctor") else ["--output", "file/out"]
            words += ["--iterations", "1"] if name == "train" else []
            words += ["--backbone", "deform"] if "hexplane" in flag else []
            words += ["--calibration", "x"] if flag.startswith("--import") else []
            words.append(f"{flag}={odd_word(rng)}")
            words = mistyped(words, rng) if number % 2 and name not in AT_WORK else words
            expect_an_answer(words, capsys, f"flags {seed} {number}")


@pytest.mark.parametrize(("count", "seed"), ROUNDS)
def test_the_environment_at_random(small: Path, capsys, monkeypatch, count: int, seed: int) -> None:
    for number in range(count // 4):
        rng = random.Random(f"environment {seed} {number}")
        with monkeypatch.context() as changed:
            for variable in rng.sample(VARIABLES, 2):
                changed.setenv(variable, odd_word(rng).encode("utf-8", "replace").decode())
            words = rng.choice((["doctor"], ["--help"], ["plan", str(small), "--train-cameras", "cam00,cam01"]))
            expect_an_answer(words, capsys, f"environment {seed} {number}")
