// The kernels of gpu.cu and the CUDA driver that launches them, as a library of the CPU; see cuda_shim.h.
#include "cuda_shim.h"

#include <string>

// A library for each number of colors may be loaded at once: without internal linkage they would share the `__shared__`
// memory of kernels that are instances of templates.
namespace {

#include "gpu.cu"

struct Kernel {
  const char* name;
  void (*run)(d2::Frame);
};
const Kernel KERNELS[] = {
    {"d2_project", d2::d2_project},
    {"d2_list", d2::d2_list},
    {"d2_render", d2::d2_render},
    {"d2_render_front", d2::d2_render_front},
    {"d2_backward", d2::d2_backward},
    {"d2_backward_front", d2::d2_backward_front},
    {"d2_backward_colors", d2::d2_backward_colors},
    {"d2_gather", d2::d2_gather},
    {"d2_project_backward", d2::d2_project_backward},
    {"d2_survey", d2::d2_survey},
    {"d2_survey_front", d2::d2_survey_front},
    {"d2_gather_survey", d2::d2_gather_survey},
};

const Kernel* find(const char* name) {
  for (const Kernel& kernel : KERNELS)
    if (std::strcmp(kernel.name, name) == 0) return &kernel;
  return nullptr;
}

}  // namespace

// Runs a kernel by its name; returns null, or what went wrong.
extern "C" const char* d2_shim_launch(const char* name, int blocks, int rows, unsigned order, const d2::Frame* frame) {
  static std::string error;
  const Kernel* kernel = find(name);
  if (!kernel) return "no such kernel";
  try {
    shim::launch(kernel->run, {unsigned(blocks), unsigned(rows), 1}, d2::THREADS, order, *frame);
    return nullptr;
  } catch (const std::exception& caught) {
    error = std::string(name) + ": " + caught.what();
    return error.c_str();
  }
}

// ---------------------------------------------------------------------------------------------------- the driver

// The part of the CUDA driver that cuda.py calls, with the types of cuda.h: one device, one context, and
// modules that know the kernels above. Strict where the real one is: no call without a current context.
extern "C" {
typedef int CUresult, CUdevice;
typedef struct CUctx_st* CUcontext;
typedef struct CUmod_st* CUmodule;
typedef struct CUfunc_st* CUfunction;
typedef struct CUstream_st* CUstream;
constexpr CUresult CUDA_SUCCESS = 0, CUDA_ERROR_INVALID_VALUE = 1, CUDA_ERROR_INVALID_CONTEXT = 201,
                   CUDA_ERROR_NO_BINARY_FOR_GPU = 209, CUDA_ERROR_NOT_FOUND = 500, CUDA_ERROR_LAUNCH_FAILED = 719;

static int contexts = 0;  // pushed
static CUstream last_stream = nullptr;
static CUcontext the_context() { return reinterpret_cast<CUcontext>(&contexts); }

CUresult cuInit(unsigned) { return CUDA_SUCCESS; }
CUresult cuDeviceGet(CUdevice* device, int ordinal) { return *device = ordinal, CUDA_SUCCESS; }
CUresult cuDevicePrimaryCtxRetain(CUcontext* context, CUdevice) { return *context = the_context(), CUDA_SUCCESS; }
CUresult cuCtxPushCurrent_v2(CUcontext context) {
  if (context != the_context()) return CUDA_ERROR_INVALID_CONTEXT;
  return contexts++, CUDA_SUCCESS;
}
CUresult cuCtxPopCurrent_v2(CUcontext* context) {
  if (contexts == 0) return CUDA_ERROR_INVALID_CONTEXT;
  return *context = the_context(), contexts--, CUDA_SUCCESS;
}
CUresult cuModuleLoadData(CUmodule* module, const void* image) {
  if (contexts == 0) return CUDA_ERROR_INVALID_CONTEXT;
  if (std::memcmp(image, "\177ELF", 4) != 0) return CUDA_ERROR_NO_BINARY_FOR_GPU;
  return *module = reinterpret_cast<CUmodule>(&last_stream), CUDA_SUCCESS;
}
CUresult cuModuleGetFunction(CUfunction* function, CUmodule, const char* name) {
  if (contexts == 0) return CUDA_ERROR_INVALID_CONTEXT;
  const Kernel* kernel = find(name);
  if (!kernel) return CUDA_ERROR_NOT_FOUND;
  return *function = reinterpret_cast<CUfunction>(const_cast<Kernel*>(kernel)), CUDA_SUCCESS;
}
CUresult cuLaunchKernel(CUfunction function, unsigned blocks_x, unsigned blocks_y, unsigned blocks_z, unsigned threads_x,
                        unsigned threads_y, unsigned threads_z, unsigned shared, CUstream stream, void** parameters,
                        void** extra) {
  if (contexts == 0) return CUDA_ERROR_INVALID_CONTEXT;
  if (blocks_x == 0 || blocks_y == 0 || blocks_z != 1 || threads_y != 1 || threads_z != 1 || shared || extra)
    return CUDA_ERROR_INVALID_VALUE;
  const dim3 grid = {blocks_x, blocks_y, 1};
  const d2::Frame& frame = *static_cast<const d2::Frame*>(parameters[0]);
  last_stream = stream;
  try {
    shim::launch(reinterpret_cast<const Kernel*>(function)->run, grid, int(threads_x), 0, frame);
  } catch (const std::exception&) {
    return CUDA_ERROR_LAUNCH_FAILED;
  }
  return CUDA_SUCCESS;
}
CUresult cuGetErrorName(CUresult error, const char** name) {
  *name = error == CUDA_ERROR_NO_BINARY_FOR_GPU ? "CUDA_ERROR_NO_BINARY_FOR_GPU" : "CUDA_ERROR";
  return CUDA_SUCCESS;
}

// What the tests look at.
int d2_shim_contexts() { return contexts; }
void* d2_shim_stream() { return last_stream; }
}
