"""The kernel of the photometric loss under AddressSanitizer, in a program of its own: nothing outside of its arrays."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from d2_plugin.gaussians.native_ssim import KERNELS
from d2_plugin.rasterizer import native

PROGRAM = r"""
#include "ssim.cpp"
#include <cstdio>
#include <memory>

// Arrays from the heap, of exactly the size that the kernel may touch.
template <class Number>
std::unique_ptr<Number[]> some(int64_t count) {
  std::unique_ptr<Number[]> array(new Number[count]);
  for (int64_t i = 0; i < count; i++) array[i] = Number(i % 7);
  return array;
}

int main() {
  for (int height : {1, 31, 64, 65, 100, 128, 131, 200})
    for (int width : {1, 5, 72, 85})
      for (int threads : {1, 2, 3})
        for (bool bytes : {false, true})
          for (bool gradient : {false, true}) {
            const int64_t count = int64_t(height) * width * 3;
            auto image = some<float>(count), target = some<float>(bytes ? 1 : count), out = some<float>(count);
            auto given = some<uint8_t>(bytes ? count : 1);
            auto differences = some<double>(height), similarities = some<double>(height);
            Photometric p = {height, width, 3, threads, 0.2f, {}, image.get(), bytes ? nullptr : target.get(),
                             bytes ? given.get() : nullptr, gradient ? out.get() : nullptr, differences.get(),
                             similarities.get()};
            for (float& weight : p.window) weight = 1 / 11.f;
            d2_photometric(&p);
          }
  std::puts("alive");
}
"""


@pytest.mark.slow
def test_no_number_outside_of_the_images_is_touched(tmp_path: Path) -> None:
    """A band of rows read up to three rows beyond its copy of the target: most times harmless, now and then a crash."""
    compiler = shutil.which("g++")
    if compiler is None or sys.platform != "linux":
        pytest.skip("g++ on Linux is needed, for its AddressSanitizer")
    source, program = tmp_path / "bounds.cpp", tmp_path / "bounds"
    source.write_text(PROGRAM)
    folders = [f"-I{KERNELS}", f"-I{Path(native.__file__).parent / 'kernels'}"]
    words = [compiler, "-std=c++17", "-O1", "-g", "-fsanitize=address", "-pthread", *folders, str(source)]
    eight = [["-march=x86-64-v3"]] if " avx2 " in Path("/proc/cpuinfo").read_text() else []
    for machine in (["-march=native"], *eight, []):  # the most lanes that run here, eight, and the fewest
        built = subprocess.run([*words, *machine, "-o", str(program)], capture_output=True, text=True, check=False)
        if machine and built.returncode:
            continue
        if "libasan" in built.stderr or "cannot find" in built.stderr:
            pytest.skip("g++ came without AddressSanitizer (libasan)")
        assert built.returncode == 0, built.stderr
        done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout) == (0, "alive\n"), done.stderr[:3000]
