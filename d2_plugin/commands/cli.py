"""The `d2` command: from a recording to a prior, a trained model, its scores, and the tables of a study."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from d2_plugin import __version__
from d2_plugin.errors import D2Error, unknown_name

ROWS_HELP = "tables (ablation, pruning, main) or presets joined by commas; an unknown name is answered by the list"
CAPTURE_HELP = (
    "folder of the recording: images/CAMERA/FRAME.png with cameras.json, or as N3DV, Technicolor, ENeRF-Outdoor, "
    "COLMAP or transforms.json lay it out"
)
CAMERAS_HELP = "names joined by commas, e.g. 00,02,05,07; or preset:2, preset:3, preset:4 for a known data set"
HOOKS_HELP = "all, none, or names of prior, densify, prune, depth_loss joined by commas"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; a mistake in the input is one sentence on stderr and exit code 2."""
    # Read when torch is first imported, further down. OpenMP threads that spin at each barrier cost a training step
    # on a busy machine 130 to 210 ms instead of 20 (two threads, 25,000 Gaussians, 240x135).
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        module = _module(words)
        if module is not None:
            return importlib.import_module(module).main(words[1:]) or 0
        options = _parser().parse_args(words)
        return options.run(options) or 0
    except D2Error as error:
        sys.stderr.write(f"d2: {error}\n")
        return 2


def _module(words: Sequence[str]) -> str | None:
    """The module that serves a command all by itself, its `--help` included."""
    if words[:1] == ["plan"] and "--verify" in words:
        words.remove("--verify")
        return "d2_plugin.study.plan_verify"
    return MODULES[words[0]][0] if words and words[0] in MODULES else None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="d2", description="Dual-source depth priors for 4D Gaussian Splatting from two to four cameras."
    )
    parser.add_argument("--version", action="version", version=f"d2-4dgs {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for add in (
        _add_demo,
        _add_plan,
        _add_priors,
        _add_train,
        _add_eval,
        _add_compare,
        _add_ablate,
        _add_bench,
        _add_doctor,
    ):
        add(commands)
    for name, (_, help) in MODULES.items():
        commands.add_parser(name, help=help, add_help=False)
    return parser


def _command(commands: Any, name: str, run: Any, help: str) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        name, help=help, description=help, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.set_defaults(run=run)
    return parser


def _add_capture_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("capture", help=CAPTURE_HELP)
    parser.add_argument("--train-cameras", required=True, type=_names, help=CAMERAS_HELP)
    parser.add_argument("--frames", type=_frames, default=None, help="first:last or first:last:step; default all")
    parser.add_argument("--downscale", type=int, default=1, help="train on pictures this many times smaller (integer)")
    parser.add_argument("--mono-onnx", default=None, help="monocular depth network as an ONNX file")
    parser.add_argument(
        "--mono-kind",
        choices=("relative", "metric"),
        default=None,
        help="what the network predicts: inverse depth or depth",
    )
    parser.add_argument("--config", type=Path, default=None, help="TOML with tables over the defaults")


def _add_train(commands: Any) -> None:
    parser = _command(commands, "train", _train, "Train on some cameras, score on the others; continues a stopped run.")
    _add_capture_options(parser)
    parser.add_argument("--test-cameras", type=_names, default=None, help="names joined by commas; default all others")
    parser.add_argument("--backbone", default="yang4d", help="which 4D Gaussian model")
    parser.add_argument("--iterations", type=int, default=3000, help="optimizer steps, one view each")
    parser.add_argument("--hooks", default="all", help=HOOKS_HELP)
    parser.add_argument("--output", type=Path, required=True, help="folder of the run; an unfinished run is continued")
    parser.add_argument("--priors", type=Path, default=None, help="folder of the depth prior; default OUTPUT/priors")
    parser.add_argument("--seed", type=int, default=0, help="of every random choice")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--export-ply", action="store_true", help="also write one 3DGS PLY per frame")


def _add_eval(commands: Any) -> None:
    parser = _command(commands, "eval", _eval, "Score the held-out cameras of a trained run again.")
    parser.add_argument("run_folder", type=Path, help="the --output of d2 train")
    parser.add_argument("--no-pictures", action="store_true", help="scores only")


def _add_compare(commands: Any) -> None:
    parser = _command(commands, "compare", _compare, "One Markdown table of the scores of several runs.")
    parser.add_argument("run_folders", type=Path, nargs="+", help="the --output folders of d2 train")


def _add_ablate(commands: Any) -> None:
    parser = _command(commands, "ablate", _ablate, "The paper's ablation tables on this recording, over several seeds.")
    _add_capture_options(parser)
    parser.add_argument("--test-cameras", type=_names, default=None, help="names joined by commas; default all others")
    parser.add_argument("--rows", type=_names, default="ablation,pruning", help=ROWS_HELP)
    parser.add_argument("--backbones", type=_names, default="yang4d", help="names joined by commas")
    parser.add_argument("--seeds", type=_numbers, default="0,1,2", help="numbers joined by commas")
    parser.add_argument("--iterations", type=int, default=2000, help="optimizer steps of each run, one view each")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="runs at a time, one thread each")
    parser.add_argument("--output", type=Path, required=True, help="folder of runs, shared priors and tables")


def _add_priors(commands: Any) -> None:
    parser = _command(commands, "priors", _priors, "Build the depth prior of a recording; finished frames are kept.")
    _add_capture_options(parser)
    parser.add_argument("--output", type=Path, required=True, help="folder of the prior store")
    parser.add_argument("--shard", type=_shard, default=None, help="build part I of N only, as I/N with I from 1 to N")
    parser.add_argument("--workers", type=int, default=None, help="build with this many processes of this machine")
    parser.add_argument("--scheduler", default=None, help="address of a dask cluster to build on, e.g. tcp://host:8786")


def _add_plan(commands: Any) -> None:
    parser = _command(commands, "plan", _plan, "What the method needs for a recording, and what is left out, and why.")
    parser.add_argument(
        "--verify", action="store_true", help="measure what each decision saves and costs; see its --help"
    )
    _add_capture_options(parser)


def _add_demo(commands: Any) -> None:
    parser = _command(commands, "demo", _demo, "Synthetic recording, backbone alone against backbone with D2.")
    parser.add_argument("--output", type=Path, default=Path("d2-demo"), help="folder for capture, runs and the picture")
    parser.add_argument("--iterations", type=int, default=1000, help="optimizer steps of each of the two runs")


def _add_bench(commands: Any) -> None:
    parser = _command(commands, "bench", _bench, "Error against run time of one part; `d2 bench PART --help` for more.")
    parser.add_argument("part", choices=sorted(BENCHMARKS), help="what to measure")
    parser.add_argument("rest", nargs=argparse.REMAINDER, help="options of that benchmark")


def _add_doctor(commands: Any) -> None:
    _command(commands, "doctor", _doctor, "What is installed, what is missing for which feature, compiler and caches.")


BENCHMARKS = {
    "align": "d2_plugin.study.bench.align",
    "raster": "d2_plugin.study.bench.raster",
    "scaling": "d2_plugin.study.bench.scaling",
    "stereo": "d2_plugin.study.bench.stereo",
}
MODULES = {
    "report": ("d2_plugin.runs.tables.report", "One page of everything measured: plots, tables, pictures."),
    "stability": ("d2_plugin.study.stability.sweep", "Sweeps over stiff and extreme cases, in float32 and float64."),
    "export-capture": ("d2_plugin.commands.export_capture", "A recording in the input layout of another repository."),
}
"""Commands that a module of their own serves: its name, and one line of help."""


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _numbers(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(name) for name in _names(text))
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not whole numbers joined by commas") from None


def _frames(text: str) -> tuple[int, ...]:
    try:
        first, last, *step = (int(part) for part in text.split(":"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not first:last or first:last:step") from None
    return tuple(range(first, last + 1, *step))


def _shard(text: str) -> tuple[int, int]:
    try:
        part, count = (int(number) for number in text.split("/"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not I/N, as in 1/4") from None
    if not 1 <= part <= count:
        raise argparse.ArgumentTypeError(f"part {part} of {count} does not exist: parts are 1 to {count}")
    return part - 1, count


def _hooks(text: str) -> tuple[str, ...]:
    from d2_plugin.runs.settings import HOOK_NAMES

    if text in ("all", "none"):
        return HOOK_NAMES if text == "all" else ()
    names = _names(text)
    for name in names:
        if name not in HOOK_NAMES:
            raise unknown_name("hook", name, [*HOOK_NAMES, "all", "none"])
    return names


def _settings(options: argparse.Namespace, **more: Any) -> Any:
    from d2_plugin.captures.presets import resolve_cameras
    from d2_plugin.runs.settings import RunSettings

    train, test, notes = resolve_cameras(options.capture, options.train_cameras, more.pop("test_cameras", None))
    _print_notes(notes)
    return RunSettings(
        capture=options.capture,
        train_cameras=train,
        test_cameras=test,
        frames=options.frames,
        downscale=options.downscale,
        mono_onnx=options.mono_onnx,
        mono_kind=options.mono_kind,
        overrides=_overrides(options.config),
        **more,
    )


def _overrides(path: Path | None) -> dict[str, Any]:
    if path is None:
        return {}
    try:
        return tomllib.loads(path.read_text())
    except FileNotFoundError:
        raise D2Error(f"no configuration at {path}: write one, or leave out --config") from None
    except tomllib.TOMLDecodeError as error:
        raise D2Error(f"{path} is not valid TOML: {error}") from None


def _train(options: argparse.Namespace) -> None:
    from d2_plugin.runs.run import Run
    from d2_plugin.runs.tables import metrics_table

    settings = _settings(
        options,
        test_cameras=options.test_cameras,
        backbone=options.backbone,
        iterations=options.iterations,
        hooks=_hooks(options.hooks),
        seed=options.seed,
        device=options.device,
        priors=str(options.priors) if options.priors else None,
    )
    run = Run(settings, options.output)
    _print_notes(run.scene.capture.notes)
    _print_plan(run.scene.plan)
    run.train()
    _print_notes([f"{name} retired at step {step}: it changed next to nothing" for name, step in run.retired.items()])
    metrics = run.evaluate()
    if options.export_ply:
        print(f"{len(run.export_ply())} PLY files in {options.output / 'ply'}")
    print(metrics_table({options.output.name: metrics}))
    print(f"metrics in {options.output / 'metrics.json'}, pictures in {options.output / 'pictures'}")


def _eval(options: argparse.Namespace) -> None:
    from d2_plugin.runs.run import Run
    from d2_plugin.runs.tables import metrics_table

    metrics = Run.load(options.run_folder).evaluate(pictures=not options.no_pictures)
    print(metrics_table({options.run_folder.name: metrics}))


def _compare(options: argparse.Namespace) -> None:
    from d2_plugin.runs.tables import metrics_table, read_metrics

    print(metrics_table({folder.name: read_metrics(folder) for folder in options.run_folders}))


def _ablate(options: argparse.Namespace) -> None:
    from d2_plugin.study.ablation import ablate
    from d2_plugin.study.ablation.presets import rows_named

    presets = rows_named(options.rows)
    base = _settings(options, test_cameras=options.test_cameras, iterations=options.iterations)
    work = ablate.jobs(base, presets, options.backbones, options.seeds, options.output)
    results = ablate.run_jobs(work, options.jobs)
    print(ablate.write(results, presets, options.output, _command_line()))
    print(f"tables and runs.jsonl in {options.output}")


def _command_line() -> str:
    """How this was started, without the folders of this machine."""
    return " ".join(["d2", *(Path(word).name if word.startswith("/") else word for word in sys.argv[1:])])


def _priors(options: argparse.Namespace) -> None:
    from d2_plugin.priors.sheet import contact_sheet
    from d2_plugin.priors.store import PriorStore
    from d2_plugin.runs.prior import build_priors_for
    from d2_plugin.runs.scene import Scene
    from d2_plugin.runs.settings import check
    from d2_plugin.runs.start import triangulated_points

    settings = check(_settings(options))
    scene = Scene.open(settings)
    _print_notes(scene.capture.notes)
    _print_plan(scene.plan)
    points = triangulated_points(scene.capture, scene.train_cameras).positions
    print(build_priors_for(settings, scene, points, options.output, shard=options.shard, cluster=_cluster(options)))
    if options.shard is None:
        sheet = options.output / "contact_sheet.png"
        contact_sheet(PriorStore.open(options.output), scene.capture, sheet)
        print(f"look at {sheet}")


def _cluster(options: argparse.Namespace) -> dict[str, Any] | None:
    """What to hand the frames to, where that is wanted."""
    if options.workers is None and options.scheduler is None:
        return None
    if options.shard is not None:
        raise D2Error("--shard builds one part on this machine: leave it out with --workers or --scheduler")
    if options.scheduler is not None:
        return {"scheduler": options.scheduler}
    return {"workers": options.workers}


def _plan(options: argparse.Namespace) -> None:
    from d2_plugin.runs.scene import Scene
    from d2_plugin.runs.settings import check

    scene = Scene.open(check(_settings(options)))
    _print_notes(scene.capture.notes)
    _print_plan(scene.plan)


def _print_notes(notes: Sequence[str]) -> None:
    for note in notes:
        print(f"     note  {note}")


def _print_plan(plan: Any) -> None:
    for decision in plan.decisions:
        print(f"{'use' if decision.use else 'leave out':>9}  {decision.name:12} {decision.reason}")


def _demo(options: argparse.Namespace) -> None:
    from d2_plugin.commands.demo import run_demo

    print(run_demo(options.output, options.iterations))


def _bench(options: argparse.Namespace) -> int | None:
    return importlib.import_module(BENCHMARKS[options.part]).main(options.rest)


def _doctor(options: argparse.Namespace) -> None:
    from d2_plugin.commands.doctor import report

    print(report())


if __name__ == "__main__":
    sys.exit(main())
