// The depth loss at the known pixels of one view with its gradient: what depth_loss.py does in torch, in one walk each way.
// Sums are taken chunk by chunk in a fixed order, so results are the same bits for any number of threads.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "parallel.h"

namespace d2 {

constexpr int64_t CHUNK = 4096;      // known pixels of one task
constexpr float SAFE_SQUARE = 1e18f;  // beyond it a square leaves the range of float32
constexpr float EPSILON = 1e-8f;

// What one call works on, as native_depth_loss.py fills it in.
struct DepthLoss {
  int64_t known, pixels;
  int32_t threads;
  float tau_v, sigma_full, epsilon, opaque;  // opaque: the weight of what one near pixel lets through
  const int64_t* index;                      // [known], ascending
  const float *depth, *sigma;                // [known]
  const uint8_t* far;                        // [known]
  const float *depth_sum, *alpha;            // [pixels]
  float *by_depth_sum, *by_alpha;            // [known], times the sum of weights
  double total;                              // the sum of weights
  float upstream;                            // what comes back to the loss
  float *grad_depth_sum, *grad_alpha;        // [pixels]
};

struct Sums {
  double weight = 0, penalty = 0, through = 0;
};

// Known pixels begin..end-1: their slopes, and what they add to the sums.
static Sums add_pixels(const DepthLoss& d, int64_t begin, int64_t end) {
  float weights[CHUNK], penalties[CHUNK], through[CHUNK], z[CHUNK], a[CHUNK];
  const int64_t count = end - begin;
  for (int64_t i = 0; i < count; i++) {
    z[i] = d.depth_sum[d.index[begin + i]];
    a[i] = d.alpha[d.index[begin + i]];
  }
  const float *prior = d.depth + begin, *sigmas = d.sigma + begin;
  const uint8_t* far = d.far + begin;
  float *by_depth_sum = d.by_depth_sum + begin, *by_alpha = d.by_alpha + begin;
  for (int64_t i = 0; i < count; i++) {
    const float weight = (d.sigma_full / std::max(sigmas[i], d.sigma_full)) * (a[i] > d.tau_v ? 1.f : 0.f);
    const float covered = (a[i] < d.tau_v ? d.tau_v : a[i]) + EPSILON, target = prior[i] + EPSILON;
    const float depth = z[i] / covered, signed_residual = (depth - prior[i]) / target;
    const float residual = far[i] && signed_residual > 0 ? 0.f : signed_residual, size = std::fabs(residual);
    const float epsilon = std::sqrt(sigmas[i] * sigmas[i] + d.epsilon * d.epsilon);
    const float floor = std::max(epsilon, std::max(sigmas[i], d.epsilon));
    const float root = size > SAFE_SQUARE ? size : std::max(std::sqrt(residual * residual + floor * floor), floor);
    const float slope = weight * (residual / root) / (target * covered);
    by_depth_sum[i] = slope;
    by_alpha[i] = -slope * depth;
    weights[i] = weight;
    penalties[i] = weight * residual * (residual / (root + floor));
    through[i] = far[i] ? 0.f : 1 - a[i];
  }
  Sums sums;
  for (int64_t i = 0; i < count; i++) {
    sums.weight += weights[i];
    sums.penalty += penalties[i];
    sums.through += through[i];
  }
  return sums;
}

// The gradient of both maps from the pixel after that of known pixel begin-1 up to that of known pixel end.
static void scatter(const DepthLoss& d, int64_t begin, int64_t end) {
  const int64_t from = begin ? d.index[begin] : 0, to = end < d.known ? d.index[end] : d.pixels;
  std::fill(d.grad_depth_sum + from, d.grad_depth_sum + to, 0.f);
  std::fill(d.grad_alpha + from, d.grad_alpha + to, 0.f);
  const float scale = float(d.upstream / d.total), near = d.upstream * d.opaque;
  for (int64_t i = begin; i < end; i++) {
    d.grad_depth_sum[d.index[i]] = scale * d.by_depth_sum[i];
    d.grad_alpha[d.index[i]] = scale * d.by_alpha[i] - (d.far[i] ? 0.f : near);
  }
}

template <class Body>
static void for_each_chunk(const DepthLoss& d, Body body) {
  parallel_for(d.threads, (d.known + CHUNK - 1) / CHUNK, [&](int64_t chunk) {
    body(chunk, chunk * CHUNK, std::min(d.known, (chunk + 1) * CHUNK));
  });
}

}  // namespace d2

using d2::DepthLoss;

extern "C" {

int64_t d2_depth_loss_size() { return sizeof(DepthLoss); }

// Fills in slopes and total; returns the loss.
double d2_depth_loss(DepthLoss* d) {
  std::vector<d2::Sums> parts(size_t((d->known + d2::CHUNK - 1) / d2::CHUNK));
  d2::for_each_chunk(*d, [&](int64_t chunk, int64_t begin, int64_t end) {
    parts[chunk] = d2::add_pixels(*d, begin, end);
  });
  d2::Sums sums;
  for (const d2::Sums& part : parts) {
    sums.weight += part.weight;
    sums.penalty += part.penalty;
    sums.through += part.through;
  }
  d->total = sums.weight + d2::EPSILON;
  return sums.penalty / d->total + d->opaque * sums.through;
}

void d2_depth_loss_backward(const DepthLoss* d) {
  d2::for_each_chunk(*d, [&](int64_t, int64_t begin, int64_t end) { d2::scatter(*d, begin, end); });
}
}
