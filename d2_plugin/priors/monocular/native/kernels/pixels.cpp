// What alignment and fusion do to each pixel alone, in one pass: the bits of NumPy, in the order of its operations.
#include <cmath>
#include <cstdint>
#include <limits>

namespace d2 {

// Mirrored by `_Aligned` in pixels.py.
struct Aligned {
  int64_t count;
  double scale, shift;
  double limit;       // relative maps: the smallest inverse depth that is one; metric ones: the largest depth
  int64_t relative;   // whether `mono` is inverse depth
  const float* mono;  // [count]
  float* depth;       // [count], or null
  double* inverse;    // [count], or null
};

// Mirrored by `_Fused` in pixels.py.
struct Fused {
  int64_t count;
  float tau, epsilon;
  double most_vetoed;
  const float *mono, *geometric;
  const float* tau_map;  // [count], or null: `tau` everywhere
  const uint8_t* hanging;
  const float *sigma_mono, *sigma_geometric;
  float* depth;
  uint8_t* labels;
  float* sigma;
  uint8_t empty, mono_label, verified, conflict;
};

}  // namespace d2

extern "C" int64_t d2_aligned_size() { return sizeof(d2::Aligned); }
extern "C" int64_t d2_fused_size() { return sizeof(d2::Fused); }

extern "C" void d2_aligned(const d2::Aligned* given) {
  const d2::Aligned call = *given;
  const double nan = std::numeric_limits<double>::quiet_NaN();
  if (call.depth)
    for (int64_t i = 0; i < call.count; i++) {
      const float mono = call.mono[i];
      const double value = call.scale * double(mono) + call.shift;
      const bool told = std::fabs(mono) <= std::numeric_limits<float>::max() && mono != 0;
      const bool near = call.relative ? value > call.limit : value > 0 && value <= call.limit;
      call.depth[i] = told && near ? float(call.relative ? 1 / value : value) : 0.f;
    }
  if (call.inverse)
    for (int64_t i = 0; i < call.count; i++) {
      const double value = call.scale * double(call.mono[i]) + call.shift;
      if (call.relative)
        call.inverse[i] = call.mono[i] == 0 && !(value < 0) ? (value != value ? value : 0) : value;
      else
        call.inverse[i] = value > 0 ? 1 / value : nan;
    }
}

extern "C" void d2_fused(const d2::Fused* given) {
  const d2::Fused call = *given;
  const auto verified = [&](int64_t i) {
    const float there = call.geometric[i], relative = std::fabs(call.mono[i] - there) / (there + call.epsilon);
    return relative < (call.tau_map ? call.tau_map[i] : call.tau);
  };
  int64_t known = 0, vetoed = 0;
  for (int64_t i = 0; i < call.count; i++) {
    const bool measured = call.geometric[i] > 0;
    known += measured;
    vetoed += measured && !verified(i);
  }
  const bool all = double(vetoed) > call.most_vetoed * double(known);
  for (int64_t i = 0; i < call.count; i++) {
    const float there = call.geometric[i], here = call.mono[i];
    const bool measured = there > 0, agrees = measured && (all || verified(i));
    const bool alone = !measured && here > 0 && !call.hanging[i];
    const float depth = agrees ? there : alone ? here : 0.f;
    call.depth[i] = depth;
    call.labels[i] = agrees ? call.verified : measured ? call.conflict : alone ? call.mono_label : call.empty;
    const float sigma = measured ? call.sigma_geometric[i] : call.sigma_mono[i];
    call.sigma[i] = depth > 0 ? sigma : std::numeric_limits<float>::infinity();
  }
}
