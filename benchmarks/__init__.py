"""Benchmarks: error against run time of one part each."""

from __future__ import annotations

from typing import NamedTuple


class Benchmark(NamedTuple):
    """One benchmark of `d2 bench`: its module holds the settings class and `run(settings) -> str`."""

    module: str
    settings: str
    """Name of the settings class in that module."""
    help: str


BENCHMARKS = {
    "align": Benchmark("benchmarks.align", "AlignBench", "the fit of monocular to geometric depth"),
    "gpu": Benchmark("benchmarks.gpu.proof", "GpuBench", "everything that a GPU has to show, in 25 minutes"),
    "never-worse": Benchmark(
        "benchmarks.never_worse.bench", "NeverWorseBench", "D² with wrong monocular maps against the backbone"
    ),
    "priors": Benchmark("benchmarks.priors", "PriorsBench", "declared against true error of the prior"),
    "raster": Benchmark("benchmarks.raster", "RasterBench", "the rasterizer: time, memory, precision"),
    "scaling": Benchmark("benchmarks.scaling", "ScalingBench", "priors and training over more frames"),
    "stereo": Benchmark("benchmarks.stereo", "StereoBench", "geometric depth: matchers and settings"),
    "training": Benchmark("d2_plugin.runs.training.bench", "TrainingBench", "D², backbone and rivals at equal time"),
    "trainers": Benchmark(
        "benchmarks.trainers.bench", "TrainersBench", "official trainers bare, without hooks, and attached"
    ),
    "training-step": Benchmark(
        "benchmarks.training_step", "TrainingStepBench", "one optimizer step beside the rasterizer's part"
    ),
}
"""Every benchmark by name; none is imported before it is asked for."""
