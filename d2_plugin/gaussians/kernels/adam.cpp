// One step of Adam over all tensors of a model at once: what torch.optim.Adam does tensor by tensor. One pass over values,
// moments and gradients; every number is updated by itself, so results are the same bits for any number of threads.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

#include "parallel.h"
#include "simd.h"

namespace d2 {

// One tensor as native_adam.py describes it.
struct AdamTensor {
  float *value, *first, *second;  // the parameter and its moments, exp_avg and exp_avg_sq
  const float* gradient;
  float* steps;  // how many steps it has made; one more afterwards
  int64_t count;
  double rate, beta1, beta2, epsilon;
};

constexpr int64_t ADAM_CHUNK = 16384;  // numbers of one task, a multiple of LANES; some ten microseconds

// What does not depend on the number: in double, as torch computes it.
struct AdamFactors {
  Floats first, second, second_kept, inverse_root, rate, epsilon;

  D2_INLINE explicit AdamFactors(const AdamTensor& t)
      : first(float(1 - t.beta1)), second(float(1 - t.beta2)), second_kept(float(t.beta2)),
        inverse_root(float(1 / std::sqrt(1 - std::pow(t.beta2, double(*t.steps))))),
        rate(float(t.rate / (1 - std::pow(t.beta1, double(*t.steps))))), epsilon(float(t.epsilon)) {}

  D2_INLINE void update(float* value, float* m, float* v, const float* gradient) const {
    const Floats g = Floats::load(gradient), before = Floats::load(m);
    const Floats moment = fma(first, g - before, before);
    const Floats square = fma(second * g, g, second_kept * Floats::load(v));
    moment.store(m);
    square.store(v);
    (Floats::load(value) - rate * moment / fma(sqrt(square), inverse_root, epsilon)).store(value);
  }
};

static void adam_chunk(const AdamTensor& t, int64_t begin) {
  const int64_t end = std::min(t.count, begin + ADAM_CHUNK), whole = begin + (end - begin) / LANES * LANES;
  const AdamFactors factors(t);
  for (int64_t i = begin; i < whole; i += LANES)
    factors.update(t.value + i, t.first + i, t.second + i, t.gradient + i);
  if (whole == end) return;
  alignas(64) float lanes[4][LANES] = {};
  float* const arrays[] = {t.value, t.first, t.second};
  const size_t bytes = sizeof(float) * size_t(end - whole);
  for (int k = 0; k < 3; k++) std::memcpy(lanes[k], arrays[k] + whole, bytes);
  std::memcpy(lanes[3], t.gradient + whole, bytes);
  factors.update(lanes[0], lanes[1], lanes[2], lanes[3]);
  for (int k = 0; k < 3; k++) std::memcpy(arrays[k] + whole, lanes[k], bytes);
}

}  // namespace d2

using d2::AdamTensor;

extern "C" {

int64_t d2_adam_size() { return sizeof(AdamTensor); }

void d2_adam(const AdamTensor* tensors, int32_t count, int32_t threads) {
  int64_t tasks = 0;
  for (int k = 0; k < count; k++) {
    *tensors[k].steps += 1;
    tasks += (tensors[k].count + d2::ADAM_CHUNK - 1) / d2::ADAM_CHUNK;
  }
  d2::parallel_for(threads, tasks, [&](int64_t task) {
    for (const AdamTensor* t = tensors;; t++) {
      const int64_t chunks = (t->count + d2::ADAM_CHUNK - 1) / d2::ADAM_CHUNK;
      if (task < chunks) return d2::adam_chunk(*t, task * d2::ADAM_CHUNK);
      task -= chunks;
    }
  });
}
}
