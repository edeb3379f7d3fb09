// The kernels of gpu.cu as a library of the CPU; see cuda_shim.h and test_rasterizer_cuda.py.
#include "cuda_shim.h"

#include "gpu.cu"

#include <string>
#include <utility>

// Runs a kernel by its name; returns null, or what went wrong.
extern "C" const char* d2_shim_launch(const char* name, int blocks, int rows, int descending, const d2::Frame* frame) {
  static const std::pair<const char*, void (*)(d2::Frame)> kernels[] = {
      {"d2_project", d2::d2_project},
      {"d2_list", d2::d2_list},
      {"d2_render", d2::d2_render},
      {"d2_backward", d2::d2_backward},
      {"d2_backward_colors", d2::d2_backward_colors},
      {"d2_gather", d2::d2_gather},
      {"d2_project_backward", d2::d2_project_backward},
      {"d2_survey", d2::d2_survey},
      {"d2_gather_survey", d2::d2_gather_survey},
  };
  static std::string error;
  try {
    for (const auto& [known, kernel] : kernels)
      if (std::string(known) == name) {
        shim::launch(kernel, {unsigned(blocks), unsigned(rows), 1}, d2::THREADS, descending != 0, *frame);
        return nullptr;
      }
    error = std::string("no kernel ") + name;
  } catch (const std::exception& caught) {
    error = std::string(name) + ": " + caught.what();
  }
  return error.c_str();
}
