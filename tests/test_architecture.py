"""The house: a room for every idea and imports that run one way; all of it is packaged, and what it says is true."""

import ast
import configparser
import functools
import re
import tomllib
from collections.abc import Iterable, Iterator
from graphlib import TopologicalSorter
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml

import d2_plugin
from d2_plugin.commands.doctor import OPTIONAL
from d2_plugin.errors import missing_extra

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
    "__main__": "(commands)",
    "rasterizer": "ground",
    "gaussians": "ground rasterizer",
    "recordings": "ground",
    "store": "ground",
    "priors": "ground recordings store",
    "hooks": "ground rasterizer store (gaussians)",
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

DOCUMENT = re.compile(r"(?<![\w./:{}*~<-])((?:[\w.-]+/)+[\w-]+\.md)\b")
LINK = re.compile(r"\]\((?![a-z]+:|#)([^)#\s]+)[^)]*\)")


@functools.cache
def modules() -> dict[str, Path]:
    """Every module by its name as it is installed."""
    found = {}
    for package, folder in PACKAGES.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            found[".".join([package, *parts]).removesuffix(".__init__")] = path
    return found


def room(module: str) -> str:
    """The folder or file of d2_plugin that a module is in, `__init__` for the package itself; `benchmarks` is one."""
    top, *inner = module.split(".")
    return top if top == "benchmarks" else (*inner, "__init__")[0]


@functools.cache
def imports_of(name: str) -> list[tuple[str, int, bool]]:
    """Each module of this project that a module imports, the line, and whether importing the one loads the other."""
    path = modules()[name]
    parts = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]

    def walk(node: ast.AST, at_once: bool) -> Iterator[tuple[str, int, bool]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.expr):
                continue  # holds no import
            inside = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)
            inside |= isinstance(child, ast.If) and any(
                getattr(n, "id", "") == "TYPE_CHECKING" for n in ast.walk(child.test)
            )
            targets: Iterable[str] = ()
            if isinstance(child, ast.Import):
                targets = [alias.name for alias in child.names]
            elif isinstance(child, ast.ImportFrom):
                above = parts[: len(parts) - child.level + 1] if child.level else []
                base = ".".join([*above, *([child.module] if child.module else [])])
                names = [f"{base}.{alias.name}" for alias in child.names]
                targets = [full if full in modules() else base for full in names]
            yield from ((target, child.lineno, at_once) for target in targets if target in modules())
            yield from walk(child, at_once and not inside)

    return list(walk(ast.parse(path.read_text(encoding="utf-8")), True))


def test_no_module_needs_itself() -> None:
    """Not by way of others either, nor by an import inside a function."""
    needs = {name: {target for target, _, _ in imports_of(name)} - {name} for name in modules()}
    TopologicalSorter(needs).prepare()  # raises CycleError, which names the circle


def test_imports_run_one_way_between_rooms() -> None:
    wrong = []
    for name in modules():
        own = room(name)
        words = ROOMS.get("ground" if own in GROUND.split() else own, "").replace("ground", GROUND).split()
        for target, line, at_once in imports_of(name):
            allowed = {own, *(word if at_once else word.strip("()") for word in words)}
            if room(target) not in allowed:
                wrong.append(f"{name}, line {line}, imports {target}, but {own} may not import {room(target)}")
    assert wrong == []


@pytest.fixture(scope="module")
def setup() -> configparser.ConfigParser:
    parser = configparser.ConfigParser(delimiters=("=",), interpolation=None)
    parser.optionxform = str
    parser.read(ROOT / "setup.cfg")
    return parser


def test_every_package_and_every_kernel_is_installed(setup: configparser.ConfigParser) -> None:
    """What setup.cfg's `packages` and `package_data` say the tree has, and the other way round."""
    places = dict(re.split(r"\s*=\s*", line) for line in setup["options"]["package_dir"].split("\n") if line.strip())
    listed = {name: ROOT / places.get(name, name.replace(".", "/")) for name in setup["options"]["packages"].split()}
    tops = [ROOT / "d2_plugin", *(ROOT / place for place in places.values())]
    assert {path.parent for top in tops for path in top.rglob("__init__.py")} == {*listed.values()}
    covered = set()
    for package, patterns in setup["options.package_data"].items():
        for pattern in re.split(r"[,\s]+", patterns.strip()):
            matches = set(listed[package].glob(pattern))
            assert matches, f"package_data's {package} = {pattern} matches no file"
            covered |= matches
    every = {path for top in tops for path in top.rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc")}
    beside = {str(path.relative_to(ROOT)) for path in every - covered}
    assert {path for path in beside if not re.search(r"(^|/)\.", path)} == set(), "in no package_data"


def test_every_document_that_is_named_is_there() -> None:
    places = [ROOT / place for place in ("docs", *PACKAGES.values(), "tests", ".ci")]
    files = [
        path for place in places for path in place.rglob("*") if path.suffix in (".md", ".py", ".h", ".cpp", ".cu")
    ]
    top = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "setup.cfg", ".ci/run")]
    missing = []
    for path in [*top, *sorted(files)]:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            names = DOCUMENT.findall(line) + (LINK.findall(line) if path.suffix == ".md" else [])
            found = [name for name in names if (ROOT / name).exists() or (path.parent / name).exists()]
            missing += [f"{path.relative_to(ROOT)}, line {number}: {name}" for name in names if name not in found]
    assert missing == []


CODE = ("d2_plugin", "backbones", "adapters")


def extras_in(text: str) -> set[str]:
    """Extras of this package that a text names, in `d2-4dgs[one,two]` or `.[one,two]`."""
    return {name.strip() for group in re.findall(r"(?:d2-4dgs|\.)\[([a-z, ]+)\]", text) for name in group.split(",")}


def test_one_version_everywhere(setup: configparser.ConfigParser) -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text()).get("project", {})
    assert "version" not in project, "pyproject.toml has a version of its own"
    assert setup["metadata"]["version"] == "attr: d2_plugin.__version__"
    assert version("d2-4dgs") == d2_plugin.__version__
    assert citation["version"] == d2_plugin.__version__
    released = re.findall(r"^## \[(\d[^\]]*)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert released[0] == d2_plugin.__version__


def test_every_extra_in_an_error_exists(setup: configparser.ConfigParser) -> None:
    code = [path.read_text(encoding="utf-8") for folder in CODE for path in (ROOT / folder).rglob("*.py")]
    call = r'(?:missing_extra|opencv)\([^(),]*,\s*"([^"]+)"'  # opencv(purpose, extra) hands its extra on
    named = {extra for text in code for extra in re.findall(call, text)}
    assert "calibration" in named
    assert named <= set(setup["options.extras_require"])
    assert extras_in(str(missing_extra("OpenCV", "image", "reading images"))) == {"image"}


def test_every_extra_in_text_exists(setup: configparser.ConfigParser) -> None:
    known = set(setup["options.extras_require"])
    files = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "setup.cfg", ROOT / ".ci" / "run"]
    files += [path for folder in CODE for path in (ROOT / folder).rglob("*.py")] + list((ROOT / "docs").rglob("*.md"))
    named = {path.name: extras_in(path.read_text(encoding="utf-8")) - known for path in files}
    assert not {name: extras for name, extras in named.items() if extras}
    assert extras_in("pip install -e '.[all,tset]' d2-4dgs[mono]") == {"all", "tset", "mono"}


def test_every_package_that_doctor_names_is_in_the_extra_that_it_names(setup: configparser.ConfigParser) -> None:
    distributions = {"cv2": "opencv-contrib-python-headless"}
    for module, (extra, *_) in OPTIONAL.items():
        assert distributions.get(module, module) in setup["options.extras_require"][extra], f"{module} not in {extra}"


def test_every_extra_of_a_user_is_in_all(setup: configparser.ConfigParser) -> None:
    together = extras_in(setup["options.extras_require"]["all"])
    assert together == set(setup["options.extras_require"]) - {"all", "test", "cuda", "older"}
