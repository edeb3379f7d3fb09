"""What the command line makes of mistakes, faults and Ctrl-C: one sentence, an exit code, no traceback."""

import json
import os
import shutil
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import pytest

from d2_plugin.commands import cli
from d2_plugin.commands.arguments import boundary
from d2_plugin.commands.arguments.boundary import one_line, sentence
from d2_plugin.commands.cli import main
from d2_plugin.errors import D2Error

Refused = Callable[..., str]


@pytest.fixture
def copy(small: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(small, tmp_path / "copy"))


class TestTheBoundary:
    """An exception becomes a sentence and an exit code."""

    @pytest.fixture
    def failing(self, monkeypatch: pytest.MonkeyPatch) -> Callable[[BaseException], None]:
        def fail_with(failure: BaseException) -> None:
            def answer(words: list[str]) -> str:
                raise failure

            monkeypatch.setattr(cli, "_answer", answer)

        return fail_with

    @pytest.mark.parametrize(
        ("failure", "code", "says"),
        [
            (KeyError("depth"), 2, "KeyError ('depth'), a fault of d2-4dgs: run the same command with --debug"),
            (KeyboardInterrupt(), 130, "stopped: continue with the same command"),
            (OSError(28, "No space left", "/out/x.tmp"), 2, "cannot use /out/x.tmp (No space left): mend that or"),
            (MemoryError(), 2, "make images smaller with --downscale 2"),
            (BrokenProcessPool("A process was terminated abruptly"), 2, "run it again with fewer --jobs"),
            (RuntimeError("DefaultCPUAllocator: can't allocate memory: 9 bytes"), 2, "smaller with --downscale 2"),
        ],
    )
    def test_says_what_to_do(self, failing: Callable, capsys, failure: BaseException, code: int, says: str) -> None:
        failing(failure)
        assert main(["train"]) == code
        error = capsys.readouterr().err
        assert error.startswith("d2: ")
        assert says in error
        assert len(error.splitlines()) == 1

    def test_debug_shows_where_it_arose(self, failing: Callable, capsys) -> None:
        failing(D2Error("no such thing: write it"))
        assert main(["train", "--debug"]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert lines[0].startswith("Traceback")
        assert lines[-1] == "d2: no such thing: write it"

    def test_a_reader_that_goes_away_is_no_error(self, failing: Callable, capsys: pytest.CaptureFixture[str]) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(boundary.os, "dup2", lambda *_: None)
            failing(BrokenPipeError())
            assert main(["doctor"]) == 141
        assert capsys.readouterr().err == ""

    def test_sentences_have_one_line_and_no_control_characters(self) -> None:
        assert one_line("a\nb\x1b[31m\ud800") == "a b\\x1b[31m\\ud800"
        assert "\n" not in sentence(ValueError("one\ntwo"))


class TestWords:
    """What people mistype."""

    @pytest.mark.parametrize(
        ("words", "says"),
        [
            (["--seed", "9" * 5000], "--seed must be"),
            (["--frames", "0:3000000000"], "1000000 numbers at most"),
            (["--frames", ",".join(["0:999999"] * 1000)], "1000000 numbers at most"),
            (["--output="], "--output must be a path, got ''"),
            (["--hooks", "all,none"], "--hooks says 'all,none': all stands alone"),
            (["--hooks", ","], "--hooks names no hook"),
            (["--hooks", "densify,depthloss"], "did you mean 'depth_loss'?"),
            (["--backbone", "yang"], "did you mean 'yang4d'?"),
            (["--train-cameras", ","], "no training camera"),
            (["--train-cameras", "cam00,cma01"], "did you mean 'cam01'?"),
            (["--train-cameras", "cam00,cam00"], "cam00 is named twice: name each once, for training or for test"),
            (["--mono-onnx", "net.onnx"], "--mono-kind"),
            (["--device", "cdua"], "cuda"),
            (["--downscale", "60000"], "leaves no pixel"),
            (["--iterations", "9" * 30], "--iterations must be at least 1 and at most 1e+09"),
            (["--depth-loss.weight", "1e308"], "--depth-loss.weight must be"),
        ],
    )
    def test_values_that_cannot_be(self, small: Path, tmp_path, refused: Refused, words: list[str], says: str) -> None:
        fixed = ["train", str(small), "--train-cameras", "cam00", "--output", str(tmp_path / "x")]
        assert says in refused(*fixed, *words)
        assert not (tmp_path / "x").exists()

    @pytest.mark.parametrize(
        "text",
        [
            "priors = 5", "backbone = []", "[[densify]]\ncell = 1", "plan = 'x'", "[priors]\nstereo = 3",
            "d2 = 2026-01-01", "[densify]\ncell = 2026-01-01T00:00:00", "[backbone]\nsh_degree = inf",
            "x = " + "[" * 3000, "= 1", "\x00", "[plan]\ntemporal = \"maybe\"", "[priors]\ndepth_range = [1, 2, 3]",
            "[d2]\ndensify = 5", "[d2]\ndensify = { scale = 1.0 }", "[prune]\ntau_pp = 0.5",
            "[plan]\nverification = false",
        ],
    )  # fmt: skip
    def test_configurations_that_cannot_be(self, small: Path, tmp_path: Path, refused: Refused, text: str) -> None:
        (tmp_path / "d2.toml").write_text(text)
        refused("plan", str(small), "--train-cameras", "cam00", "--config", str(tmp_path / "d2.toml"))


class TestPlaces:
    """Files, folders and other things where the other is expected."""

    def test_a_configuration_that_is_a_pipe_or_a_folder(self, small: Path, tmp_path: Path, refused: Refused) -> None:
        os.mkfifo(tmp_path / "pipe.toml")
        plan = ["plan", str(small), "--train-cameras", "cam00", "--config"]
        assert "is a pipe, expected a file" in refused(*plan, str(tmp_path / "pipe.toml"))
        assert "is a folder, expected a file" in refused(*plan, str(tmp_path))
        assert "(there is no such file): correct the configuration, or leave out --config" in refused(
            *plan, str(tmp_path / "none.toml")
        )

    @pytest.mark.parametrize("output", ["file", "file/below", "x" * 300, "a/" + "y" * 5000])
    def test_an_output_that_cannot_be(self, small: Path, tmp_path: Path, refused: Refused, output: str) -> None:
        (tmp_path / "file").write_text("mine")
        words = ["train", str(small), "--train-cameras", "cam00", "--hooks", "none", "--iterations", "1"]
        refused(*words, "--output", str(tmp_path / output))
        assert (tmp_path / "file").read_text() == "mine"

    def test_a_image_that_claims_to_be_huge(self, copy: Path, refused: Refused) -> None:
        image = copy / "images" / "cam01" / "00001.png"
        data = bytearray(image.read_bytes())
        data[16:24] = (100_000).to_bytes(4, "big") * 2
        image.write_bytes(data)
        assert "says 100000x100000 pixels" in refused("plan", str(copy), "--train-cameras", "cam00,cam01")

    @pytest.mark.parametrize("name", ["a,b", "..", "../x", "a/b", " a", "", "x" * 300, "a\nb"])
    def test_a_camera_whose_name_cannot_be_used(self, copy: Path, refused: Refused, name: str) -> None:
        described = json.loads((copy / "cameras.json").read_text())
        described["cameras"][0]["name"] = name
        (copy / "cameras.json").write_text(json.dumps(described))
        assert "rename it" in refused("plan", str(copy), "--train-cameras", "cam01")

    def test_a_depth_map_that_only_evaluation_reads_is_named_before_training(self, copy, tmp_path, refused) -> None:
        (copy / "depth" / "cam01" / "00001.npz").write_bytes(b"PK\x03\x04 no archive")
        words = ["train", str(copy), "--train-cameras", "cam00", "--hooks", "none", "--output", str(tmp_path / "x")]
        assert "00001.npz" in refused(*words)
        assert not (tmp_path / "x").exists()
