"""What each official trainer needs for a short run: its layout, its arguments, and where it says how well it did.

Nothing of a repository is copied here: these are the names of its options, with values for a few hundred iterations.
A schedule that counts iterations is shortened in proportion, so that densification takes place within the run, or is
left as the script has it.
"""

import re
import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from d2_plugin.reading import json_text

TRAINED, HELD_OUT = ("00", "02", "05", "07"), ("01", "03", "04", "06")
"""Cameras of the recordings."""


@dataclass(frozen=True)
class Job:
    """One run of one trainer."""

    data: Path
    """Folder that `d2 export-recording` wrote."""
    output: Path
    """Folder of the run, which exists."""
    iterations: int
    frames: int
    seconds: float
    """Length of the clip."""
    own_schedules: bool = False
    """Leave schedules as the script has them."""

    @property
    def model(self) -> Path:
        """What the trainer is told to write to."""
        return self.output / "model"

    def write(self, name: str, text: str) -> str:
        """A file for the trainer in the run's folder; returns its path."""
        path = self.output / name
        path.write_text(text, encoding="utf-8")
        return str(path)

    def share(self, part: float) -> int:
        """That part of the iterations, at least one."""
        return max(1, round(part * self.iterations))

    def schedule(self, parts: dict[str, float]) -> dict[str, int]:
        """Options that count iterations, as parts of the run; none where the script's own stay."""
        return {} if self.own_schedules else {name: self.share(part) for name, part in parts.items()}

    def schedule_words(self, parts: dict[str, float]) -> list[str]:
        """The same as arguments of a script."""
        return [word for name, count in self.schedule(parts).items() for word in (f"--{name}", str(count))]

    @property
    def reports(self) -> list[str]:
        """The iterations at which a trainer is asked for its report."""
        return [str(self.share(part)) for part in (0.25, 0.5, 0.75, 1.0)]


def free_port() -> str:
    """A port for trainers that open a viewer's; nobody connects to it."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return str(probe.getsockname()[1])


Scores = Callable[[Job, str], dict[int, float]]
"""From a finished job and what it printed: PSNR in dB by iteration."""


def _found(line: str) -> Scores:
    # The last of equal iterations counts.
    return lambda job, printed: {int(number): float(psnr) for number, psnr in re.findall(line, printed)}


reported = _found(r"\[ITER (\d+)\] Evaluating test: L1 \S+ PSNR ([\d.]+)")
"""The trainer's own `Evaluating test` lines."""
scored_after = _found(r"\[held out\] iteration (\d+): PSNR ([\d.]+)")
"""What `inside` printed once the script had ended."""


def gsplat_stats(job: Job, printed: str) -> dict[int, float]:
    """stats/val_stepNNNN.json, whose steps count from 0; LPIPS in there may be NaN, which is no JSON."""
    found = {}
    for path in sorted((job.model / "stats").glob("val_step*.json")):
        psnr = re.search(r'"psnr": ([\d.]+)', path.read_text(encoding="utf-8"))
        if psnr:
            found[int(path.stem.removeprefix("val_step")) + 1] = float(psnr[1])
    return found


@dataclass(frozen=True)
class Trial:
    """One repository."""

    source: str
    """owner/name; its last part is the name of the folder of the checkout."""
    layout: str
    """Format of `d2 export-recording`."""
    held_out: tuple[str, ...]
    """Cameras that it is scored on, of those that are not trained on."""
    words: Callable[[Job], list[str]]
    """Arguments of its script; writes its configuration where it needs one."""
    scores: Scores = reported
    scored_on: str = "all held-out cameras"
    script: str = "train.py"
    points: int = 1000
    """Least number of initial points."""
    least_side: int = 1
    """Pixels that the shorter side of an image must have."""
    clock: Literal["seconds", "share"] | None = None
    """Its unit of time, since the first frame: seconds, or the share of the clip. None: instants between those that it
    trains on cannot be asked for."""
    also_held_out: bool = False
    """Whether the held-out cameras are exported a second time, as if they were trained on, to be scored on."""

    @property
    def folder(self) -> str:
        """Name of the folder of its checkout."""
        return self.source.rpartition("/")[2]


DENSIFY = {
    **{"densify_from_iter": 0.2, "densify_until_iter": 0.8, "densification_interval": 0.1},
    "position_lr_max_steps": 1.0,
}
"""What most scripts call these parts of a run."""


def _fudan(job: Job) -> list[str]:
    config = {
        **{"gaussian_dim": 4, "time_duration": [0.0, job.seconds], "num_pts": 100000, "num_pts_ratio": 1.0},
        **{"rot_4d": True, "force_sh_3d": False, "batch_size": 2, "exhaust_test": False, "seed": 0},
        "ModelParams": {
            **{"sh_degree": 3, "source_path": str(job.data), "model_path": str(job.model), "resolution": 1},
            **{"eval": True, "extension": ".png", "dataloader": True, "loaded_pth": ""},
        },
        "PipelineParams": {"env_map_res": 0, "eval_shfs_4d": True},
        "OptimizationParams": {
            **{"iterations": job.iterations, "lambda_rigid": 0.0},
            **job.schedule(DENSIFY | {"densification_interval": 0.25, "densify_from_iter": 0.4}),
            **job.schedule({"sh_increase_interval": 0.25}),
        },
    }
    path = job.write("config.yaml", json_text(config, "config.yaml", indent=1))  # JSON is YAML
    return ["--config", path, "--test_iterations", *job.reports, "--save_iterations", "1000000"]


def _4c4d(job: Job) -> list[str]:
    return [*_fudan(job), "--initial_num_pts", "100000"]


def _deformable3d(job: Job) -> list[str]:
    return [
        *("-s", str(job.data), "-m", str(job.model), "--eval", "--iterations", str(job.iterations)),
        *job.schedule_words(DENSIFY | {"warm_up": 0.25, "densify_from_iter": 0.3, "deform_lr_max_steps": 1.0}),
        *("--test_iterations", *job.reports),
    ]


def _hust4d(job: Job) -> list[str]:
    optimization = {
        **{"dataloader": True, "iterations": job.iterations, "batch_size": 1, "coarse_iterations": job.share(1 / 3)},
        **job.schedule(DENSIFY),
        **{"opacity_threshold_coarse": 0.005, "opacity_threshold_fine_init": 0.005},
        "opacity_threshold_fine_after": 0.005,
    }
    planes = {"grid_dimensions": 2, "input_coordinate_dim": 4, "output_coordinate_dim": 16}
    hidden = {
        "kplanes_config": planes | {"resolution": [64, 64, 64, max(4, job.frames // 2)]},
        **{"multires": [1, 2], "defor_depth": 0, "net_width": 64, "plane_tv_weight": 0.0002},
        **{"time_smoothness_weight": 0.001, "l1_time_planes": 0.0001},
    }
    text = f"ModelHiddenParams = {hidden!r}\nOptimizationParams = {optimization!r}\n"
    words = ["-s", str(job.data), "-m", str(job.model), "--configs", job.write("config.py", text)]
    return [*words, "--test_iterations", *job.reports, "--port", free_port()]


def _spacetime(job: Job) -> list[str]:
    config: dict[str, Any] = {
        **{"resolution": 1, "model": "ours_lite", "scaling_lr": 0.0015, "preprocesspoints": 0, "batch": 2},
        **{"duration": job.frames, "rdpip": "train_ours_lite", "iterations": job.iterations},
        **job.schedule(DENSIFY),
    }
    return [
        *("--eval", "--source_path", str(job.data / "colmap_0"), "--model_path", str(job.model)),
        *("--configpath", job.write("config.json", json_text(config, "config.json")), "--densify", "3"),
        *("--iterations", str(job.iterations), "--save_iterations", str(job.iterations)),
    ]


def _ex4dgs(job: Job, extraction: str = "extracton_interval") -> list[str]:
    config = {
        **{"loader": "neural3dvideo", "resolution": 1, "iterations": job.iterations, "lazy_loader": True},
        **{"duration": job.frames, "start_duration": job.frames, "end_timestamp": job.frames},
        **job.schedule(DENSIFY | {"dynamic_position_lr_max_steps": 1.0}),
        # Always within the run: a model in which nothing moves yet cannot be saved.
        **{"extract_from_iter": job.share(0.25), extraction: job.share(0.15)},
        "progressive_growing_steps": 100000,
    }
    path = job.write("config.json", json_text(config, "config.json"))
    words = ["-s", str(job.data), "-m", str(job.model), "--configpath", path]
    return [*words, "--test_iterations", *job.reports, "--port", free_port()]


def _cem4dgs(job: Job) -> list[str]:
    return _ex4dgs(job, "extraction_interval")  # the option's name is spelt right there


def _gsplat(job: Job) -> list[str]:
    refine = {"strategy.refine_start_iter": 0.2, "strategy.refine_every": 0.1, "strategy.refine_stop_iter": 0.8}
    return [
        *("default", "--disable_viewer", "--disable_video", "--no-normalize_world_space", "--no-load_exposure"),
        *("--data_dir", str(job.data), "--data_factor", "1", "--result_dir", str(job.model), "--test_every", "2"),
        *("--max_steps", str(job.iterations), "--eval_steps", *job.reports, "--tb_every", "0"),
        *job.schedule_words(refine | {"sh_degree_interval": 1 / 3}),
    ]


TRIALS = {
    "fudan": Trial(
        *("fudan-zvg/4d-gaussian-splatting", "transforms", HELD_OUT, _fudan),
        clock="seconds",
        least_side=161,  # its report measures MS-SSIM, whose fifth scale needs ten pixels and one more
    ),
    "4c4d": Trial("yangzf-1023/4C4D", "transforms", HELD_OUT, _4c4d),
    "deformable3d": Trial(
        "ingra14m/Deformable-3D-Gaussians", "n3dv", HELD_OUT[:1], _deformable3d, scored_on="the first held-out camera"
    ),
    "hust4d": Trial(
        *("hustvl/4DGaussians", "multipleview", (), _hust4d, scored_after),
        scored_on="all held-out cameras, read and drawn by its own code after `train.py`",
        clock="share",
        also_held_out=True,
    ),
    "spacetime": Trial(
        *("oppo-us-research/SpacetimeGaussians", "colmap_frames", HELD_OUT[:1], _spacetime, scored_after),
        scored_on="the first held-out camera, drawn by its own code after `train.py`",
        clock="share",
        points=300,
    ),
    "ex4dgs": Trial(
        "juno181/Ex4DGS", "colmap_frames", HELD_OUT[:1], _ex4dgs, scored_on="the first held-out camera", points=300
    ),
    "cem4dgs": Trial(
        "tho-kn/cem-4dgs", "colmap_frames", HELD_OUT[:1], _cem4dgs, scored_on="the first held-out camera", points=300
    ),
    "gsplat": Trial(
        *("nerfstudio-project/gsplat", "gsplat", HELD_OUT, _gsplat, gsplat_stats),
        scored_on="all held-out cameras at the first frame",
        script="examples/simple_trainer.py",
    ),
}
"""By the name that the launcher knows it by."""
