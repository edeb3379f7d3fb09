"""Command lines and configurations at random: an answer, or one sentence that is no fault of ours."""

from __future__ import annotations

import random
import string
from pathlib import Path

import pytest
from fuzzing import ODD_TEXTS, ODD_VALUES, bounded_memory, mutate_file
from small_layouts import write_layout

from d2_plugin.commands.cli import COMMANDS, main

pytest.importorskip("cv2", reason="opencv is in the `image` extra")

FEW, MANY = 60, 2000


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_layout("folder", tmp_path_factory.mktemp("recording") / "small")


def random_words(rng: random.Random, recording: Path, output: Path) -> list[str]:
    """A command line that a person might have meant, with a few words replaced."""
    command = rng.choice([name for name in COMMANDS if name not in ("demo", "bench", "doctor", "ablate")])
    words = [command, str(recording), "--train-cameras", "cam00,cam01", "--output", str(output), "--iterations", "1"]
    flags = ("seed", "frames", "downscale", "hooks", "config", "mono-onnx", "mono-kind", "test-cameras", "shard")
    tables = ("densify.spacing", "prune.tau-p", "priors.stereo.min-angle", "plan.temporal", "backbone.sh-degree")
    odd = [str(value) for value in ODD_VALUES] + list(ODD_TEXTS) + ["preset:4", "1/0", "cam00", "none", "all", "true"]
    for _ in range(rng.choice((0, 1, 1, 2, 3))):
        words += [f"--{rng.choice(flags + tables)}", rng.choice(odd)]
    for _ in range(rng.choice((1, 1, 2))):
        place = rng.randrange(len(words))
        match rng.randrange(4):
            case 0:
                del words[place]
            case 1:
                words[place] = rng.choice(odd)
            case 2:
                letters = list(words[place])
                letters[rng.randrange(len(letters) or 1) : 1] = [rng.choice(string.printable)]
                words[place] = "".join(letters)
            case _:
                words.insert(place, rng.choice(words))
        if not words:
            break
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


def fuzz_words(count: int, seed: int, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Run mutated command lines; what would work for long is refused beforehand, by a place that cannot be written."""
    (tmp_path / "file").write_text("in the way of every output")
    with bounded_memory():
        for number in range(count):
            rng = random.Random(f"words {seed} {number}")
            words = random_words(rng, recording, tmp_path / "file" / "out")
            expect_an_answer(words, capsys, f"words {seed} {number}")


def fuzz_configurations(
    count: int, seed: int, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Plan with a mutated configuration."""
    from d2_plugin.config import for_iterations

    path = tmp_path / "d2.toml"
    tables = for_iterations(("densify", "prune", "depth_loss"), 100).to_toml().splitlines()
    whole = "\n".join(
        line for line in tables if line.startswith(("[", "spacing", "tau", "lambda", "every", "scale", "weight"))
    )
    whole += "\n[plan]\ntemporal = true\n[priors]\ndepth_range = [1.0, 9.0]\n[priors.stereo]\nmin_angle = 1.0\n"
    whole += "[backbone]\nsh_degree = 1\n[d2]\nretire_after = 3\n"
    words = ["plan", str(recording), "--train-cameras", "cam00,cam01", "--config", str(path)]
    path.write_text(whole)
    assert main(words) == 0, capsys.readouterr().err
    with bounded_memory():
        for number in range(count):
            path.write_text(whole)
            mutate_file(path, random.Random(f"configuration {seed} {number}"))
            expect_an_answer(words, capsys, f"configuration {seed} {number}")


ROUNDS = [(FEW, 0), pytest.param(MANY, 1, marks=pytest.mark.slow)]


@pytest.mark.parametrize(("count", "seed"), ROUNDS)
def test_command_lines_at_random(
    recording: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    count: int,
    seed: int,
) -> None:
    monkeypatch.chdir(tmp_path)
    fuzz_words(count, seed, recording, tmp_path, capsys)


@pytest.mark.parametrize(("count", "seed"), ROUNDS)
def test_configurations_at_random(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], count: int, seed: int
) -> None:
    fuzz_configurations(count, seed, recording, tmp_path, capsys)
