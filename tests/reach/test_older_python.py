"""What a trainer's process imports is little, and runs where official environments stand: Python 3.9 and torch 2.0."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Optional

import pytest
from mimics.workplace import furnish
from refusals import refuses

from d2_plugin import older, registry
from d2_plugin.config import D2Config
from d2_plugin.hooks import HOOKS
from d2_plugin.settings import Range, Settings, declared

MOST = 45
"""Modules of this project in an attached process, its adapter among them; four of them are the store's."""

OUTSIDE = ("d2_plugin.priors", "d2_plugin.recordings", "d2_plugin.runs", "d2_plugin.viewing", "d2_plugin.commands")
"""Rooms that no trainer needs."""

NOT_NEEDED = ("cv2", "pycolmap", "onnxruntime", "rich", "matplotlib")
"""Packages that training does without; a bare import needs neither these nor torch and numpy."""

ATTACHED = f"""
import sys
for name in {NOT_NEEDED}:
    sys.modules[name] = None  # an import of it now fails
import no_dynamo, torch
from d2_plugin import D2Hooks
from d2_plugin.protocol import View
from d2_plugin.adapters.gsplat_dict import GsplatAdapter

parameters = {{"means": (8, 3), "scales": (8, 3), "quats": (8, 4), "opacities": (8,)}}
parameters |= {{"sh0": (8, 1, 3), "shN": (8, 0, 3)}}
torch.manual_seed(0)
splats = torch.nn.ParameterDict({{name: torch.nn.Parameter(torch.rand(shape)) for name, shape in parameters.items()}})
with torch.no_grad():
    splats["means"][:, 2] += 2.5
optimizers = {{name: torch.optim.Adam([value], lr=1e-3) for name, value in splats.items()}}
d2 = D2Hooks.from_config("d2.toml", backbone=GsplatAdapter(splats, optimizers, {{}}))
K = torch.tensor([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]])
pose = torch.eye(4)
pose[0, 3] = 0.4
for step in range(1, 11):
    d2.loss(step, View("cam0", 0, 0.0, pose, K, 32, 24)).backward()
    for optimizer in optimizers.values():
        optimizer.step()
        optimizer.zero_grad()
    d2.step(step)
assert {{"densify", "prune", "depth_loss"}} <= set(d2.hooks) and d2.trace
print(*(name for name in sys.modules if name.partition(".")[0] == "d2_plugin"))
"""
"""Ten attached steps; prints what they loaded."""

LOADED = """
import importlib, pkgutil
from d2_plugin import registry
import d2_plugin.attach.launch, d2_plugin.store.exported
for room in ("hooks", "gaussians", "rasterizer", "adapters", "compat", "attach"):
    package = importlib.import_module("d2_plugin." + room)
    for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if not found.name.endswith("__main__"):
            importlib.import_module(found.name)
for name in registry.names(registry.ADAPTERS):
    registry.load(registry.ADAPTERS, name)
print(*(
    module.__file__ for name, module in sorted(sys.modules.items())
    if name.split(".")[0] == "d2_plugin" and getattr(module, "__file__", None)
))
"""
"""Imports, in the same process, all that a trainer may, and prints the files that this loads."""


def printed(script: str) -> list[list[str]]:
    """The words of each line that a script prints in a process of its own."""
    paths = filter(None, [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH")])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [line.split() for line in done.stdout.splitlines()]


@pytest.fixture(scope="module")
def trainer(tmp_path_factory: pytest.TempPathFactory) -> list[list[str]]:
    """Modules that attached steps loaded, and the files of all that a trainer may import."""
    with pytest.MonkeyPatch.context() as patch:
        furnish(tmp_path_factory.mktemp("workplace"), patch)
        return printed(ATTACHED + LOADED)[-2:]


def test_importing_the_plugin_imports_nothing_else() -> None:
    [names] = printed("import sys, d2_plugin; print(*sys.modules)")
    assert [name for name in names if name.startswith("d2_plugin")] == ["d2_plugin"]
    assert not {"torch", "numpy", *NOT_NEEDED} & set(names)


def test_an_attached_step_needs_torch_and_numpy_and_imports_the_core_and_the_store_alone(trainer: list) -> None:
    names = trainer[0]
    assert not [name for name in names if name.startswith(OUTSIDE)]
    assert len(names) <= MOST, "\n".join(names)


def test_what_a_trainer_imports_keeps_to_python_3_9(trainer: list) -> None:
    pytest.importorskip("vermin", reason="needs vermin")
    files = trainer[1]
    names = {Path(file).relative_to(Path(files[0]).parent).as_posix() for file in files if "d2_plugin" in file}
    assert {"plugin.py", "protocol.py", "settings.py", "store/store.py", "attach/launch.py"} <= names
    options = ["--no-tips", "--violations", "--no-parse-comments", "--exclude", "long"]  # Tensor.long is no Python 2
    command = [sys.executable, "-c", "from vermin import main; main()", *options, "-t=3.9-", *files]
    judged = subprocess.run(command, capture_output=True, text=True, check=False)
    assert judged.returncode == 0, judged.stdout + judged.stderr


def unions_at_run_time(text: str) -> list[str]:
    """`A | None` and `A | B` of types outside annotations, which Python 3.9 cannot evaluate and vermin does not see."""
    tree, types = ast.parse(text), {"None", "str", "int", "float", "bool", "list", "dict", "tuple", "Path", "Mapping"}
    notes = [getattr(node, name, None) for node in ast.walk(tree) for name in ("annotation", "returns")]
    inside = {id(node) for note in notes if note is not None for node in ast.walk(note)}
    unions = (n for n in ast.walk(tree) if isinstance(n, ast.BinOp) and isinstance(n.op, ast.BitOr))
    found = [ast.unparse(node) for node in unions if id(node) not in inside]
    return [union for union in found if "{" not in union and types & set(union.split(" | "))]


def test_no_union_of_types_is_evaluated_at_run_time(trainer: list) -> None:
    found = {file: unions_at_run_time(Path(file).read_text()) for file in trainer[1]}
    assert {file: unions for file, unions in found.items() if unions} == {}
    assert unions_at_run_time("x = f(float | None)\ndef g(a: int | None) -> str | None: ...") == ["float | None"]


class TestAnnotations:
    """Settings are declared as `int | None`, which Python 3.9 evaluates with a stand-in."""

    @pytest.mark.parametrize("kind", [D2Config, *(hook.config for hook in HOOKS.values())])
    def test_the_stand_in_reads_what_newer_pythons_read(self, kind: type) -> None:
        pytest.importorskip("eval_type_backport", reason="needs eval-type-backport")
        assert older.backported_hints(kind) == older.hints_of(kind)

    def test_unions_are_known_in_both_spellings(self) -> None:
        @dataclass(frozen=True)
        class Old(Settings):
            share: Optional[Annotated[float, Range(0, 1)]] = None  # noqa: UP045  as the stand-in evaluates it

        refuses(r"Old.share", Old, share=2.0)
        assert declared(Old)[0].default is None

    def test_a_missing_stand_in_is_named_with_its_command(self) -> None:
        says = r"cannot read TOML by itself: run `pip install tomli`"
        refuses(says, older.stand_in, "no_such_module", "tomli", "read TOML")


def test_entry_points_are_found_in_the_shape_of_python_3_9(monkeypatch: pytest.MonkeyPatch) -> None:
    found = {point.name: point for point in registry.entry_points(group=registry.ADAPTERS)}
    monkeypatch.setattr(registry.sys, "version_info", (3, 9, 2))
    monkeypatch.setattr(registry, "entry_points", lambda: {registry.ADAPTERS: tuple(found.values())})
    assert registry.names(registry.ADAPTERS) == sorted(found)
    assert registry.names("d2_plugin.no_such_group") == []


def test_the_command_line_says_which_python_it_needs(refused: Callable[..., str], monkeypatch) -> None:
    """`d2` is for the environment where priors are built; a trainer's may be older and needs the three lines alone."""
    monkeypatch.setattr(sys, "version_info", (3, 9, 2, "final", 0))
    assert "the commands need Python 3.11 or later, this is 3.9: run them in another environment" in refused("plan")
