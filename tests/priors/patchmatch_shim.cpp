// The kernels of patchmatch.cu as a library of the CPU; see cuda_shim.h and test_patchmatch_gpu.py.
#include "cuda_shim.h"

#include <string>

namespace {

#include "patchmatch.cu"

struct Kernel {
  const char* name;
  void (*run)(d2::Call);
};
const Kernel KERNELS[] = {
    {"d2_patchmatch_begin", d2::d2_patchmatch_begin},
    {"d2_patchmatch_update", d2::d2_patchmatch_update},
    {"d2_patchmatch_average", d2::d2_patchmatch_average},
};

}  // namespace

// Runs a kernel by its name; returns null, or what went wrong.
extern "C" const char* d2_shim_launch(const char* name, int blocks, unsigned order, const d2::Call* call) {
  static std::string error;
  try {
    for (const Kernel& kernel : KERNELS) {
      if (std::strcmp(kernel.name, name)) continue;
      shim::launch(kernel.run, {unsigned(blocks), 1, 1}, d2::THREADS, order, *call);
      return nullptr;
    }
  } catch (const std::exception& caught) {
    error = std::string(name) + ": " + caught.what();
    return error.c_str();
  }
  return "no such kernel";
}
