"""Words on a command line become checked values: by the declarations alone, with one sentence for every mistake."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import pytest
from refusals import refuses

from d2_plugin.commands.arguments.form import Form, Given, Group
from d2_plugin.commands.arguments.help import help_text
from d2_plugin.settings import Positional, Range, Settings, Share, Steps, declared


@dataclass(frozen=True)
class Edges(Settings):
    """How edges are found."""

    width: Annotated[int, Range(1, unit="pixels")] = 3
    """Of the window. Studio: 28.9 dB at 3, 28.1 at 5."""
    scales: tuple[float, ...] = (0.25, 0.12)
    """Coarse to fine."""


@dataclass(frozen=True)
class Pruning:
    """Not a Settings yet: a plain dataclass is read as well."""

    every: int = 100
    """Steps between evaluations."""
    stop: int | None = 2000
    """First step at which it no longer runs."""
    enabled: bool = True
    """Whether it runs."""
    edges: Edges = field(default_factory=Edges)


@dataclass(frozen=True)
class Work(Settings):
    """What the command does."""

    place: Annotated[Path, Positional()]
    """Where it is."""
    output: Path
    """Where it goes."""
    frames: tuple[int, ...] | None = None
    """Which."""
    names: tuple[str, ...] = ()
    """Who."""
    kind: Literal["relative", "metric"] | None = None
    """What."""
    steps: Steps = 10
    """How long."""
    share: Share = 0.5
    """How much."""
    no_images: bool = False
    """Less."""


@dataclass(frozen=True)
class Unions(Settings):
    """Kinds that are not one plain type; no word is taken by its place."""

    stop: int | Literal["end"] = "end"
    near: Annotated[float, Range(0, open_low=True)] | None = None
    limits: tuple[float, float] | None = None
    sizes: tuple[Annotated[int, Range(1)], ...] = ()


def form_of(kind: type = Work) -> Form:
    return Form("d2 work", "Works.", declared(kind), lambda given: None, lambda typed: {"prune": Group(Pruning)})


def given(*words: str, kind: type = Work) -> Given:
    fixed = ["room", "--output", "out"] if kind is Work else []
    return form_of(kind).parse([*fixed, *words])


def test_of_a_list_that_is_given_twice_the_last_counts_and_that_is_said(caplog: pytest.LogCaptureFixture) -> None:
    given = form_of().parse(["here", "--output", "there", "--frames", "1", "--steps=3", "--steps=4", "--frames=2,3"])
    assert (given.values["frames"], given.values["steps"]) == ((2, 3), 4)
    assert caplog.messages == ["--frames is given twice and 2,3 counts alone: several go in one, with commas"]


class TestValues:
    def test_what_is_not_given_keeps_its_default(self) -> None:
        assert given().make(Work) == Work(Path("room"), Path("out"))

    @pytest.mark.parametrize(
        ("kind", "words", "name", "value"),
        [
            (Work, ["--frames", "3:9:3"], "frames", (3, 6, 9)),
            (Work, ["--frames", "0:2,7"], "frames", (0, 1, 2, 7)),
            (Work, ["--frames", "none"], "frames", None),
            (Work, ["--names", "a, b,,c"], "names", ("a", "b", "c")),
            (Work, ["--kind=metric"], "kind", "metric"),
            (Work, ["--steps", "1_000"], "steps", 1000),
            (Work, ["--share", "1"], "share", 1.0),
            (Work, ["--no_images"], "no_images", True),
            (Unions, ["--stop", "5"], "stop", 5),
            (Unions, ["--stop", "end"], "stop", "end"),
            (Unions, ["--near", "2"], "near", 2.0),
            (Unions, ["--near", "none"], "near", None),
            (Unions, ["--limits", "1,9.5"], "limits", (1.0, 9.5)),
            (Unions, ["--sizes", "1:3"], "sizes", (1, 2, 3)),
        ],
    )
    def test_each_kind_is_written_as_a_person_writes_it(self, kind, words, name, value) -> None:
        found = getattr(given(*words, kind=kind).make(kind), name)
        assert found == value
        assert type(found) is type(value)

    def test_a_word_behind_a_switch_or_a_list_is_taken_by_its_place(self) -> None:
        for flag in (["--no-images"], ["--names", "a,b"]):
            found = form_of().parse([*flag, "room", "--output", "out"]).make(Work)
            assert found.place == Path("room")

    def test_dotted_flags_become_nested_tables_without_defaults(self) -> None:
        found = given("--prune.every", "5", "--prune.enabled", "false", "--prune.edges.scales=.5,.1")
        assert found.tables == {"prune": {"every": 5, "enabled": False, "edges": {"scales": [0.5, 0.1]}}}
        assert given("--prune.stop", "none").tables == {"prune": {"stop": None}}
        assert given().tables == {}


class TestMistakes:
    @pytest.mark.parametrize(
        ("kind", "words", "message"),
        [
            (Work, ["--outptu", "x"], "unknown flag --outptu of d2 work; did you mean --output?"),
            (Work, ["--evry", "5"], "unknown flag --evry of d2 work; did you mean --prune.every?"),
            (Work, ["--prune.edges.widht", "5"], r"did you mean --prune\.edges\.width\?"),
            (Work, ["--zzz"], "unknown flag --zzz of d2 work: `d2 work --help` lists the flags"),
            (Work, ["--n", "a"], "unknown flag --n of d2 work"),
            (Work, ["--steps"], "--steps needs a value"),
            (Work, ["--steps", "--no-images"], "--steps needs a value"),
            (Work, ["--steps", "ten"], "setting --steps must be a whole number, got 'ten'"),
            (Work, ["--frames", "0-8"], "--frames is '0-8': give whole numbers joined by commas, or first:last"),
            (Work, ["--frames", "0:8:0"], "--frames is '0:8:0'"),
            (Work, ["--frames", "3:0"], "--frames is '3:0': .* with the first at most the last"),
            (Work, ["--frames", "3:0:-1"], "--frames is '3:0:-1'"),  # which would leave 0 and 1 out
            (Work, ["--frames", ""], "--frames is '': give whole numbers"),
            (Work, ["--prune.edges.width", "0"], "--prune.edges.width must be at least 1 pixel, got 0"),
            (Work, ["--prune.enabled", "perhaps"], "--prune.enabled must be"),
            (Work, ["--prune.enabled"], "--prune.enabled needs a value"),
            (Work, ["second"], "d2 work has no place for 'second'"),
            (Unions, ["--sizes", "0,1"], r"--sizes\[0\] must be at least 1, got 0"),
            (Unions, ["--stop", "never"], "--stop"),
        ],
    )
    def test_each_is_one_sentence_that_names_the_flag(self, kind: type, words: list[str], message: str) -> None:
        refuses(message, given, *words, kind=kind)

    def test_what_is_missing_is_named_all_at_once(self) -> None:
        refuses("d2 work needs PLACE and --output", form_of().parse, [])


class TestHelp:
    def test_says_unit_range_default_and_what_is_needed(self) -> None:
        text = " ".join(help_text(form_of(), ["--help"]).split())
        assert "usage: d2 work PLACE --output PATH [more flags]" in text
        assert "--steps N How long. (steps, at least 0; default 10)" in text
        assert "--share X How much. (at least 0 and at most 1; default 0.5)" in text
        assert "--kind relative|metric What." in text
        assert "--no-images Less. --" not in text
        assert "--output PATH Where it goes. (needed)" in text
        assert "(above 0)" in help_text(form_of(Unions), ["--help"])
