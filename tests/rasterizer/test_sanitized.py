"""All kernels under AddressSanitizer, the GPU's in the fibre shim and in any order: no access outside of any array."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1]
SANITIZED = "-O1 -g -fsanitize=address -fno-omit-frame-pointer"
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Kernels are compiled with the sanitizer, whose library is loaded before Python."""
    compiler = shutil.which("g++")
    if compiler is None or sys.platform != "linux":
        pytest.skip("g++ on Linux is needed, whose AddressSanitizer can be loaded before Python")
    # The C++ library as well: the sanitizer looks for its exceptions when it starts, before torch brings it.
    libraries = [_library(compiler, name) for name in ("libasan.so", "libstdc++.so.6")]
    if not all(Path(library).is_file() for library in libraries):
        pytest.skip("g++ came without AddressSanitizer (libasan.so)")
    return {
        **os.environ,
        "LD_PRELOAD": " ".join(libraries),
        "ASAN_OPTIONS": "detect_leaks=0:detect_stack_use_after_return=0",
        "CXX": compiler,
        "D2_CXXFLAGS": SANITIZED,
        "D2_CACHE": str(tmp_path_factory.mktemp("sanitized")),
        "PYTHONPATH": os.pathsep.join(map(str, (TESTS, TESTS / "priors", TESTS / "rasterizer"))),
    }


def _library(compiler: str, name: str) -> str:
    words = [compiler, f"-print-file-name={name}"]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()


def run(words: list[str], environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *words], cwd=TESTS.parent, env=environment, capture_output=True, text=True, check=False
    )


SSIM = ("gaussians/test_native_ssim.py", "torch_in_float64 or threads or bytes")


@pytest.mark.parametrize(
    ("module", "chosen", "machine"),
    [
        ("rasterizer/test_rasterizer_kernels.py", "shim and (one or forty or survey_is) or order_of", ""),
        ("priors/test_patchmatch_gpu.py", "shim and (window or bits) or order_of", ""),
        *(
            (*SSIM, machine) for machine in ("-march=native", "-march=x86-64-v3", "-march=x86-64")
        ),  # lanes: most, 8, few
    ],
)
def test_no_kernel_leaves_its_arrays(module: str, chosen: str, machine: str, environment: dict[str, str]) -> None:
    if "v3" in machine and " avx2 " not in Path("/proc/cpuinfo").read_text():
        pytest.skip("no AVX2 here")
    words = ["-m", "pytest", "-s", "-q", "-n", "0", "-p", "no:cacheprovider", f"tests/{module}", "-k", chosen]
    done = run(words, environment | {"D2_CXXFLAGS": f"{SANITIZED} {machine}"})
    said = (done.stdout + done.stderr)[-4000:]
    assert done.returncode == 0, said
    assert " passed" in done.stdout, said
    assert "AddressSanitizer" not in said, said


WHOLE = """
import sys
import torch
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.commands.cli import main

torch.set_num_threads(3)
room = synthetic_recording(cameras=3, held_out=1, frames=2, width=133, height=99, arc_degrees=25)
save_recording(room, sys.argv[1] + "/c")
words = ["train", sys.argv[1] + "/c", "--train-cameras", "train0,train1,train2", "--output", sys.argv[1] + "/run"]
sys.exit(main([*words, "--iterations", "30"]))
"""


def test_a_prior_and_a_training_stay_inside_their_arrays(tmp_path: Path, environment: dict[str, str]) -> None:
    """The CPU's kernels, with more threads than one: stereo, rasterizer, losses, slices, optimizer."""
    done = run(["-c", WHOLE, str(tmp_path)], environment)
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    assert "PSNR" in done.stdout
    assert {path.name.split("-")[0] for path in Path(environment["D2_CACHE"]).glob("*.so")} >= {"ssim", "background"}
