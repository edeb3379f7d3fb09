// The depth loss of one view with its gradient: what depth_loss.py does in torch. The maps of the prior are walked over
// as they are kept, beside those of the render: first for the sum of weights, which sigma and alpha give, then for the
// penalties and the finished gradients.
// Sums are taken chunk by chunk in a fixed order, so results are the same bits for any number of threads.
#include <algorithm>
#include <cstdint>
#include <vector>

#include "parallel.h"
#include "simd.h"

namespace d2 {

constexpr int64_t CHUNK = 4096;      // pixels of one task
constexpr int64_t WORTH_WAKING = 32;  // chunks; fewer are done before another thread is awake
constexpr int RUN = 16;              // vectors that are added up in float32 before the sum goes to float64
constexpr float SAFE_SQUARE = 1e18f;  // beyond it a square leaves the range of float32
constexpr float LEAST = 1e-15f;       // of epsilon: far below what residuals are rounded to, and its square is normal
constexpr float EPSILON = 1e-8f;

// What one call works on, as native_depth_loss.py fills it in.
struct DepthLoss {
  int64_t pixels;
  int32_t threads;
  float tau_v, sigma_full, epsilon;
  double opaque, factor;                // what one near pixel lets through, and all together, count by these
  const uint8_t* kind;                  // [pixels]: 0 where nothing is known, 1 near, 2 far
  const float *depth, *sigma;           // [pixels]; sigma null where it is 0
  const float *depth_sum, *alpha;       // [pixels]
  float *grad_depth_sum, *grad_alpha;   // [pixels], or null
};

// Three sums in float64, each from runs of vectors in float32.
struct Sums {
  double weight = 0, penalty = 0, through = 0;
};

// A vector of each map that a pixel needs; beyond the last pixel nothing is known.
struct Pixels {
  Mask known, far;
  Floats sigma, alpha;

  D2_INLINE Pixels(const DepthLoss& d, int64_t at, int64_t count) {
    uint8_t some[LANES] = {};
    if (count < LANES) std::memcpy(some, d.kind + at, size_t(count));
    const Floats kind = load_bytes(count < LANES ? some : d.kind + at);
    known = kind > Floats(0.5f), far = kind > Floats(1.5f);
    sigma = d.sigma ? where(andnot(known, far), load(d.sigma, at, count)) : Floats(0.f);
    alpha = load(d.alpha, at, count);
  }

  static D2_INLINE Floats load(const float* map, int64_t at, int64_t count) {
    if (count == LANES) return Floats::load(map + at);
    float lane[LANES] = {};
    std::memcpy(lane, map + at, sizeof(float) * size_t(count));
    return Floats::load(lane);
  }
  static D2_INLINE void store(Floats values, float* map, int64_t at, int64_t count) {
    if (count == LANES) return values.store(map + at);
    float lane[LANES];
    values.store(lane);
    std::memcpy(map + at, lane, sizeof(float) * size_t(count));
  }

  // How much each pixel counts.
  D2_INLINE Floats weight(const DepthLoss& d) const {
    const Floats full = d.sigma_full;
    return where(known & (alpha > Floats(d.tau_v)), select(sigma > full, full * reciprocal(sigma), Floats(1.f)));
  }
};

template <class Body>
static D2_INLINE void for_each_vector(const DepthLoss& d, int64_t begin, Body body) {
  const int64_t end = std::min(d.pixels, begin + RUN * LANES);
  for (int64_t at = begin; at + LANES <= end; at += LANES) body(at, int64_t(LANES));
  if (const int64_t rest = (end - begin) % LANES) body(end - rest, rest);
}

static double sum_weights(const DepthLoss& d, int64_t begin, int64_t end) {
  double total = 0;
  for (; begin < end; begin += RUN * LANES) {
    Floats run = 0.f;
    for_each_vector(d, begin, [&](int64_t at, int64_t count) D2_FLAT { run = run + Pixels(d, at, count).weight(d); });
    total += double(sum(run));
  }
  return total;
}

// The penalties of pixels begin..end-1 and what they let through, and both gradients; `scale`: factor over weights.
static Sums compare(const DepthLoss& d, float scale, int64_t begin, int64_t end) {
  Sums sums;
  const Floats eps = EPSILON, zero = 0.f, one = 1.f, epsilon = std::max(d.epsilon, LEAST);
  const Floats through_slope = float(d.factor * d.opaque);
  for (; begin < end; begin += RUN * LANES) {
    Floats penalties = 0.f, through = 0.f;
    for_each_vector(d, begin, [&](int64_t at, int64_t count) D2_FLAT {
      const Pixels pixels(d, at, count);
      const Floats prior = select(pixels.known, Pixels::load(d.depth, at, count), one), weight = pixels.weight(d);
      const Floats covered = select(pixels.alpha < Floats(d.tau_v), Floats(d.tau_v), pixels.alpha) + eps;
      const Floats target = prior + eps, part = reciprocal(target * covered);
      const Floats depth = Pixels::load(d.depth_sum, at, count) * (target * part);
      const Floats signed_residual = (depth - prior) * (covered * part);
      const Floats residual = select(pixels.far & (signed_residual > zero), zero, signed_residual);
      const Floats size = abs(residual), wide = max(pixels.sigma, epsilon);
      const Floats least = fma(pixels.sigma, pixels.sigma, epsilon * epsilon), square = fma(residual, residual, least);
      const Floats floor = least * reciprocal_root(least), steep = reciprocal_root(square);
      Floats by_root = residual * steep, by_bound = residual * reciprocal(fma(square, steep, floor));
      if (const Mask huge = max(size, wide) > Floats(SAFE_SQUARE); any(huge)) {
        const Floats root = max(size, wide);
        by_root = select(huge, residual / root, by_root), by_bound = select(huge, residual / (root + wide), by_bound);
      }
      penalties = penalties + where(pixels.known, weight * residual * by_bound);
      const Mask near = andnot(pixels.known, pixels.far);
      through = through + where(near, one - pixels.alpha);
      if (!d.grad_depth_sum) return;
      const Floats slope = where(pixels.known, Floats(scale) * weight * by_root * part);
      Pixels::store(slope, d.grad_depth_sum, at, count);
      Pixels::store(where(pixels.known, -slope * depth) - where(near, through_slope), d.grad_alpha, at, count);
    });
    sums.penalty += double(sum(penalties));
    sums.through += double(sum(through));
  }
  return sums;
}

template <class Body>
static void for_each_chunk(const DepthLoss& d, Body body) {
  const int64_t chunks = (d.pixels + CHUNK - 1) / CHUNK;
  parallel_for(chunks < WORTH_WAKING ? 1 : d.threads, chunks, [&](int64_t chunk) {
    body(chunk, chunk * CHUNK, std::min(d.pixels, (chunk + 1) * CHUNK));
  });
}

}  // namespace d2

using d2::DepthLoss;

extern "C" {

int64_t d2_depth_loss_size() { return sizeof(DepthLoss); }

// Fills in the gradients; returns the loss.
double d2_depth_loss(const DepthLoss* d) {
  std::vector<d2::Sums> parts(size_t((d->pixels + d2::CHUNK - 1) / d2::CHUNK));
  d2::for_each_chunk(*d, [&](int64_t chunk, int64_t begin, int64_t end) {
    parts[size_t(chunk)].weight = d2::sum_weights(*d, begin, end);
  });
  double total = d2::EPSILON;
  for (const d2::Sums& part : parts) total += part.weight;
  const float scale = float(d->factor / total);
  d2::for_each_chunk(*d, [&](int64_t chunk, int64_t begin, int64_t end) {
    parts[size_t(chunk)] = d2::compare(*d, scale, begin, end);
  });
  d2::Sums sums;
  for (const d2::Sums& part : parts) sums.penalty += part.penalty, sums.through += part.through;
  return d->factor * (sums.penalty / total + d->opaque * sums.through);
}
}
