"""What the package says of itself is true: one version everywhere, extras that exist, an import that loads little."""

import configparser
import re
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml

import d2_plugin
from d2_plugin.commands.doctor import OPTIONAL
from d2_plugin.errors import missing_extra

ROOT = Path(__file__).resolve().parents[1]
CODE = ("d2_plugin", "backbones", "adapters")


@pytest.fixture(scope="module")
def setup() -> configparser.ConfigParser:
    parser = configparser.ConfigParser(delimiters=("=",), interpolation=None)
    parser.optionxform = str
    parser.read(ROOT / "setup.cfg")
    return parser


@pytest.fixture(scope="module")
def citation() -> dict:
    return yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))


def extras_in(text: str) -> set[str]:
    """Extras of this package that a text names, in `d2-4dgs[one,two]` or `.[one,two]`."""
    return {name.strip() for group in re.findall(r"(?:d2-4dgs|\.)\[([a-z, ]+)\]", text) for name in group.split(",")}


def test_one_version_everywhere(setup: configparser.ConfigParser, citation: dict) -> None:
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
