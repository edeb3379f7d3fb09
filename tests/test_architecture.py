"""The house: a room for every idea, arrows one way, no circle. `ROOMS` is the plan, and the imports are held to it."""

from __future__ import annotations

import configparser
import re
from pathlib import Path
from typing import ClassVar

import pytest
from house import (
    House,
    missing_documents,
    text_files,
    unknown_rooms,
    unpackaged,
    wrong_arrows,
)

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {"d2_plugin": "d2_plugin", "d2_plugin.backbones": "backbones", "d2_plugin.adapters": "adapters"}
PACKAGES |= {"benchmarks": "benchmarks"}

GROUND = (
    "errors older settings values reading arrays protocol registry progress extras compiler cache durable locks "
    "__init__"
)
"""What everybody may use: sentences, declarations, plain data, names, progress, the compiler of kernels and its cache,
files that are kept, and locks."""

# room: what it may import. In parentheses: inside functions only, so that loading the room does not load the other.
# `benchmarks` is what developers measure: no wheel installs it, it may import all, and nobody imports it.
# Nobody may import `backbones` or `adapters`: they are found by name, as entry points. `backbones` know nothing of D2,
# so their ground, and the adapters', is spelled out.
ROOMS = {
    "ground": "ground",
    "__init__": "ground (plugin) (config)",
    "rasterizer": "ground",
    "gaussians": "ground rasterizer",
    "recordings": "ground",
    "store": "ground",
    "priors": "ground recordings store",
    "hooks": "ground rasterizer",
    "config": "ground hooks",
    "plugin": "ground config hooks (store)",
    "runs": "ground config plugin hooks priors store recordings gaussians rasterizer",
    "viewing": "ground config plugin hooks priors store recordings gaussians rasterizer runs",
    "benchmarks": "ground config plugin hooks priors store recordings gaussians rasterizer "
    "runs viewing commands testing attach",
    "commands": "ground config plugin hooks priors store recordings gaussians rasterizer runs viewing testing (attach)",
    "testing": "ground config plugin hooks rasterizer gaussians",
    "compat": "ground gaussians rasterizer",
    "attach": "ground config plugin hooks (store) recordings gaussians rasterizer compat",
    "backbones": "errors settings values compiler protocol rasterizer gaussians",
    "adapters": "errors protocol rasterizer gaussians backbones",
}


def nothing_in(complaints: list[str]) -> None:
    """Fail with one complaint a line and nothing else."""
    if complaints:
        pytest.fail("\n".join(complaints), pytrace=False)


@pytest.fixture(scope="module")
def house() -> House:
    return House.read({name: ROOT / folder for name, folder in PACKAGES.items()})


@pytest.fixture(scope="module")
def setup() -> configparser.ConfigParser:
    parser = configparser.ConfigParser(delimiters=("=",))
    parser.optionxform = str
    parser.read(ROOT / "setup.cfg")
    return parser


def test_no_module_needs_itself(house: House) -> None:
    nothing_in([f"these need each other: {', '.join(circle)}" for circle in house.circles()])


def test_every_room_is_in_the_plan(house: House) -> None:
    nothing_in([f"room '{name}' is not in ROOMS: add it" for name in unknown_rooms(house, ROOMS, GROUND)])


def test_arrows_run_one_way(house: House) -> None:
    nothing_in(wrong_arrows(house, ROOMS, GROUND))


def test_the_plan_itself_has_no_circle() -> None:
    rooms = {name: set(entry.replace("(", "").replace(")", "").split()) - {name} for name, entry in ROOMS.items()}
    del rooms["ground"], rooms["__init__"]
    while free := [name for name, below in rooms.items() if not below & rooms.keys()]:
        for name in free:
            del rooms[name]
    assert not rooms, f"these rooms may import each other: {sorted(rooms)}"


def test_every_package_and_every_kernel_is_installed(setup: configparser.ConfigParser) -> None:
    nothing_in(unpackaged(ROOT, setup))


def test_every_document_that_is_named_is_there() -> None:
    places = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "setup.cfg", "docs", *PACKAGES.values(), "tests", ".ci"]
    patterns = ["*.md", "*.py", "*.h", "*.cpp", "*.cu", "setup.cfg", "run"]
    nothing_in(missing_documents(ROOT, text_files(ROOT, places, patterns)))


def test_all_json_is_written_by_one_function() -> None:
    """`json_text` refuses NaN and Infinity by name, which `json.dumps` writes into files that nothing else reads."""
    plain = {"reading.py", "durable.py", "config.py", "settings.py", "files.py"}  # hashes, copies and TOML: no files
    writers = [
        path.relative_to(ROOT)
        for folder in PACKAGES.values()
        for path in (ROOT / folder).rglob("*.py")
        if path.name not in plain and re.search(r"\bjson\.dumps?\(", path.read_text(encoding="utf-8"))
    ]
    nothing_in([f"{path} writes JSON by itself: use d2_plugin.reading.json_text" for path in writers])


class TestTheReaderFinds:
    """Each rule is broken once in a made-up tree, so a green test above says something."""

    PLAN: ClassVar = {"ground": "ground", "low": "ground", "high": "ground low", "lazy": "ground (low)"}

    @staticmethod
    def house(root: Path, **files: str) -> House:
        for name, text in files.items():
            path = root / "d2_plugin" / f"{name.replace('__in__', '/')}.py"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return House.read({"d2_plugin": root / "d2_plugin"})

    def arrows(self, house: House) -> list[str]:
        return wrong_arrows(house, self.PLAN, "errors")

    def test_a_circle(self, tmp_path: Path) -> None:
        house = self.house(
            tmp_path, one="import d2_plugin.two", two="from d2_plugin import three", three="from . import one"
        )
        assert house.circles() == [["d2_plugin.one", "d2_plugin.three", "d2_plugin.two"]]

    def test_a_circle_by_way_of_a_package(self, tmp_path: Path) -> None:
        files = {
            "high__in__a": "from d2_plugin.low.b import x",
            "low__in____init__": "import d2_plugin.high.a",
            "low__in__b": "",
        }
        assert self.house(tmp_path, **files).circles() == [["d2_plugin.high.a", "d2_plugin.low"]]

    def test_a_package_that_its_own_module_asks_for_a_name(self, tmp_path: Path) -> None:
        files = {"low__in____init__": "from .b import x\ny = 1", "low__in__b": "from d2_plugin.low import y"}
        assert self.house(tmp_path, **files).circles() == [["d2_plugin.low", "d2_plugin.low.b"]]

    def test_no_circle_in_a_package_that_collects_its_modules(self, tmp_path: Path) -> None:
        files = {
            "low__in____init__": "from .b import x",
            "low__in__b": "from d2_plugin.low.c import z",
            "low__in__c": "",
        }
        assert self.house(tmp_path, **files).circles() == []

    def test_a_circle_although_one_import_waits(self, tmp_path: Path) -> None:
        house = self.house(tmp_path, one="import d2_plugin.two", two="def f():\n    import d2_plugin.one")
        assert house.circles() == [["d2_plugin.one", "d2_plugin.two"]]

    def test_no_circle_where_one_import_is_for_types(self, tmp_path: Path) -> None:
        for_types = "if TYPE_CHECKING:\n    import d2_plugin.one"
        assert self.house(tmp_path, one="import d2_plugin.two", two=for_types).circles() == []

    @pytest.mark.parametrize(
        "text",
        [
            "import d2_plugin.high.a",
            "from d2_plugin.high import a",
            "from ..high.a import x",
            "def f():\n    from d2_plugin.high.a import x",
            "if TYPE_CHECKING:\n    from d2_plugin.high.a import x",
            "importlib.import_module('d2_plugin.high.a')",
        ],
    )
    def test_an_arrow_that_runs_up(self, tmp_path: Path, text: str) -> None:
        (sentence,) = self.arrows(
            self.house(tmp_path, low__in__b=text, high__in__a="import d2_plugin.errors", errors="")
        )
        assert sentence.startswith("d2_plugin.low.b, line ")
        assert sentence.endswith("imports d2_plugin.high.a, but low may not import high")

    def test_an_arrow_that_must_wait(self, tmp_path: Path) -> None:
        house = self.house(tmp_path, low__in__b="", lazy="def f():\n    import d2_plugin.low.b\nimport d2_plugin.low.b")
        assert self.arrows(house) == [
            "d2_plugin.lazy, line 3, imports d2_plugin.low.b, but lazy may not import low: "
            "allowed inside a function only (at once now)"
        ]

    def test_a_room_without_a_plan(self, tmp_path: Path) -> None:
        house = self.house(tmp_path, attic__in__a="import d2_plugin.errors", errors="")
        assert unknown_rooms(house, self.PLAN, "errors") == ["attic"]
        assert self.arrows(house)

    def test_files_that_would_not_be_installed(self, tmp_path: Path) -> None:
        setup = configparser.ConfigParser()
        setup.read_string(
            "[options]\npackages =\n  d2_plugin\n  d2_plugin.gone\npackage_dir =\n  d2_plugin.adapters = adapters\n"
            "[options.package_data]\nd2_plugin = *.h, *.cu\n"
        )
        self.house(tmp_path, __init__="", low__in____init__="")
        for name in ("kernel.h", "kernel.cpp"):
            (tmp_path / "d2_plugin" / name).touch()
        wrong = [line.replace(f"{tmp_path}/", "") for line in unpackaged(tmp_path, setup)]
        assert wrong == [
            "d2_plugin.gone is in `packages` but d2_plugin/gone is no package",
            "d2_plugin/low is a package but not in `packages`",
            "package_data's d2_plugin = *.cu matches no file",
            "d2_plugin/kernel.cpp is in no package_data",
        ]

    def test_a_document_that_is_not_there(self, tmp_path: Path) -> None:
        gone = "/".join(["notes", "gone.md"])  # in pieces: this file is read by the test above as well
        (tmp_path / "page.md").write_text(
            f"[here](page.md) [web](https://a.b/c.md) [there](there.png)\nsee {gone}, 2\n"
        )
        assert missing_documents(tmp_path, [tmp_path / "page.md"]) == [
            "page.md, line 1, names there.png, which is not there",
            f"page.md, line 2, names {gone}, which is not there",
        ]
