"""What names a recording and the settings of a run: declared once, for `d2 train`, `priors`, `plan` and `ablate`.

Defaults come first, the tables of a --config file over them, and flags over both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from d2_plugin.commands.arguments.form import Form, Given, Group
from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.progress import show
from d2_plugin.reading import read_toml as tables_of_toml
from d2_plugin.settings import Settings, declared

if TYPE_CHECKING:
    from d2_plugin.runs.plan import ScenePlan
    from d2_plugin.runs.settings import RunSettings

RECORDING = ("recording", "train_cameras", "frames", "downscale", "mono_onnx", "mono_kind", "multiview")
"""Settings of a run that say what is trained on."""

WRITTEN = {
    "recording": "images/CAMERA/FRAME.png with cameras.json, or as N3DV, Technicolor, ENeRF-Outdoor, COLMAP or "
    "transforms.json lay it out.",
    "train_cameras": "Names joined by commas, as in 00,02,05,07; all; preset:2, preset:3, preset:4 for a data set; "
    "or protocol:gc-4dgs-4, protocol:4c4d and others for a published split.",
    "test_cameras": "Names joined by commas.",
    "frames": "Written first:last or first:last:step, the last one included.",
    "hooks": "all, none, or names joined by commas.",
}
"""How some settings are written on a command line, behind what their docstrings say."""


@dataclass(frozen=True)
class ConfigFile(Settings):
    """The file of settings that every command on a recording takes."""

    config: Path | None = None
    """TOML file with tables of settings, as `--help` lists them; they replace the defaults."""


def recording_form(
    command: str,
    about: str | None,
    run: Callable[[Given], str | None],
    more: Sequence[str] = (),
    options: type = ConfigFile,
    tables: Sequence[str] = (),
) -> Form:
    """The form of a command on a recording.

    It takes the settings of a run in `RECORDING` and `more`, those of its own in `options`, which replace settings of a
    run with the same name, and `tables` of settings (all if none are named) by dotted flags, that of the
    import beside --calibration alone.
    """
    from d2_plugin.runs.settings import RunSettings

    own = declared(options)
    of_run = {setting.name: setting._replace(more=WRITTEN.get(setting.name, "")) for setting in declared(RunSettings)}
    taken = [of_run[name] for name in (*RECORDING, *more) if name not in {setting.name for setting in own}]

    def groups(typed: Mapping[str, str]) -> dict[str, Group]:
        named = typed.get("backbone") or typed.get("backbones") or "yang4d"
        known = all_tables(named.partition(",")[0])
        return {name: known[name] for name in tables or known if name != "import" or "calibration" in typed}

    return Form(command, about or "", (*taken, *own), run, groups, {"hooks": hook_names})


def all_tables(backbone: str) -> dict[str, Group]:
    """The tables of settings of a run that may be given by flags, with the class that declares each."""
    from d2_plugin import registry
    from d2_plugin.config import D2Config
    from d2_plugin.priors.settings import PriorSettings
    from d2_plugin.recordings.importing.settings import ImportChoices
    from d2_plugin.runs.settings import PlanChoices

    hooks = {s.name: kind for s in declared(D2Config) for kind in (s.kind, *get_args(s.kind)) if is_dataclass(kind)}
    module: Any = registry.load(registry.BACKBONES, backbone)
    return {
        **{name: Group(kind) for name, kind in hooks.items() if isinstance(kind, type)},
        "d2": Group(D2Config, (*hooks, "exported", "iterations")),  # for other trainers
        "priors": Group(PriorSettings),
        "backbone": Group(type(module.settings_from({})), ("raster",)),  # constants of splatting: in a file alone
        "training": Group(module.TrainSettings, ("iterations", "seed")),
        "plan": Group(PlanChoices),
        "import": Group(ImportChoices),
    }


def run_settings(given: Given, **more: Any) -> RunSettings:
    """The settings of a run that were given, with camera presets resolved and the tables of file and flags."""
    from d2_plugin.recordings.presets import resolve_cameras, split_name
    from d2_plugin.runs.settings import RunSettings, layered

    train, test, notes = resolve_cameras(
        given.values["recording"], given.values["train_cameras"], given.values.get("test_cameras")
    )
    show_notes(notes)
    overrides = layered(read_toml(given.values["config"]), given.tables)
    overrides.pop("import", None)  # of the recording, not of the run
    more["protocol"] = split_name(given.values["train_cameras"])
    return given.make(RunSettings, train_cameras=train, test_cameras=test, overrides=overrides, **more)


def table_of_config(given: Given, name: str) -> dict[str, Any]:
    """One table of settings: that of the --config file with the flags over it."""
    from d2_plugin.runs.settings import layered

    both = layered(read_toml(given.values["config"]), given.tables)
    table = both.get(name, {})
    return table if isinstance(table, dict) else {name: table}


def hook_names(text: str) -> tuple[str, ...]:
    """Names of hooks joined by commas, or `all` or `none`."""
    from d2_plugin.runs.settings import HOOK_NAMES

    if text in ("all", "none"):
        return HOOK_NAMES if text == "all" else ()
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise D2Error("--hooks names no hook: write none to train without any, or leave it out for all")
    for name in names:
        if name in ("all", "none"):
            raise D2Error(f"--hooks says '{text}': {name} stands alone, or name the hooks, joined by commas")
        if name not in HOOK_NAMES:
            raise unknown_name("hook", name, [*HOOK_NAMES, "all", "none"])
    return tuple(name for name in HOOK_NAMES if name in names)  # in whatever order they are named, it is one run


def read_toml(path: Path | None) -> dict[str, Any]:
    """The tables of a --config file; none where there is no file."""
    return {} if path is None else tables_of_toml(path, "correct the configuration, or leave out --config")


def show_notes(notes: Sequence[str]) -> None:
    """What is worth knowing about a recording or a choice."""
    show(*(f"     note  {note}" for note in notes))


def show_plan(plan: ScenePlan) -> None:
    """Each decision with its measurement."""
    show(*(f"{'use' if one.use else 'leave out':>9}  {one.name:12} {one.reason}" for one in plan.decisions))
