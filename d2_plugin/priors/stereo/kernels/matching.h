// How well a plane explains the pictures: bilaterally weighted NCC between a window of the reference and a source.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>

#include "planes.h"

namespace d2 {

constexpr int kSamples = 32;            // of a window: two AVX-512, four AVX2 or eight SSE vectors
constexpr float kNoMatch = 2.f;         // the worst 1 - NCC: outside of the source, behind it, or without texture
constexpr float kMinVariance = 0.65f;   // grey levels squared (1e-5 in 0..1): below it NCC correlates rounding errors
constexpr float kWindowSigma = 3.f;     // of the weight over distance, pixels
constexpr float kMaxReprojection = 3.f; // pixels; farther off does not count as worse

extern "C" {

struct Picture {
  int32_t width, height;
  const uint8_t* gray;
};

// A source view as the reference sees it: pixel p of the reference at inverse depth q is at A p + k q in the source.
struct Source {
  int32_t width, height;
  const uint32_t* quads;  // per pixel the grey values of itself, its right, lower and lower right neighbour
  float A[9], k[3];
  float back_A[9], back_k[3];  // the same from the source to the reference
  const float* depth;          // of the source, or null where no geometric term is wanted
};

}  // extern "C"

// Weights over grey value and distance, and the sampling pattern: a 6 x 6 grid over 11 x 11 pixels without its corners.
struct Window {
  float color[256];
  float spatial[kSamples];
  int du[kSamples], dv[kSamples];

  explicit Window(float contrast) {
    for (int level = 0; level < 256; level++) {
      const float d = level / (255 * contrast);
      color[level] = std::exp(-.5f * d * d);
    }
    int n = 0;
    for (int y = -5; y <= 5; y += 2) {
      for (int x = -5; x <= 5; x += 2) {
        if (std::abs(x) == 5 && std::abs(y) == 5) continue;
        du[n] = x, dv[n] = y;
        spatial[n++] = std::exp(-(x * x + y * y) / (2 * kWindowSigma * kWindowSigma));
      }
    }
  }
};

// The window around one pixel of the reference; weights sum to 1.
struct Patch {
  alignas(64) float u[kSamples], v[kSamples];
  alignas(64) float weight[kSamples], weighted[kSamples];  // weight, and weight times (grey value - mean)
  float variance;

  Patch(const Window& window, const Picture& picture, int x, int y) {
    const int centre = picture.gray[size_t(y) * picture.width + x];
    float value[kSamples], total = 0, mean = 0;
    for (int k = 0; k < kSamples; k++) {
      const int column = x + window.du[k], row = y + window.dv[k];
      const bool inside = column >= 0 && row >= 0 && column < picture.width && row < picture.height;
      const int level = inside ? picture.gray[size_t(row) * picture.width + column] : centre;
      u[k] = float(column), v[k] = float(row), value[k] = float(level);
      weight[k] = inside ? window.spatial[k] * window.color[std::abs(level - centre)] : 0.f;
      total += weight[k];
    }
    for (int k = 0; k < kSamples; k++) weight[k] /= total, mean += weight[k] * value[k];
    variance = 0;
    for (int k = 0; k < kSamples; k++) {
      weighted[k] = weight[k] * (value[k] - mean);
      variance += weighted[k] * (value[k] - mean);
    }
  }
};

// 1 - NCC in 0..2 between the patch around (u, v) and what `plane` makes the source show of it.
inline float match(const Source& source, const Patch& patch, const Plane& plane, float u, float v) {
  float H[9];  // the homography A + k (a b c) of the plane
  for (int row = 0; row < 3; row++) {
    H[3 * row] = source.A[3 * row] + source.k[row] * plane.a;
    H[3 * row + 1] = source.A[3 * row + 1] + source.k[row] * plane.b;
    H[3 * row + 2] = source.A[3 * row + 2] + source.k[row] * plane.c;
  }
  const float z = H[6] * u + H[7] * v + H[8];
  if (!(z > 1e-6f) || patch.variance < kMinVariance) return kNoMatch;
  const float x = (H[0] * u + H[1] * v + H[2]) / z, y = (H[3] * u + H[4] * v + H[5]) / z;
  if (!(x >= 0 && y >= 0 && x <= float(source.width - 1) && y <= float(source.height - 1))) return kNoMatch;

  const float last_x = std::max(source.width - 1.001f, 0.f), last_y = std::max(source.height - 1.001f, 0.f);
  const int stride = source.width;
  const uint32_t* quads = source.quads;
  float mean = 0, square = 0, product = 0;
#pragma omp simd reduction(+ : mean, square, product)
  for (int k = 0; k < kSamples; k++) {
    const float scale = 1.f / (H[6] * patch.u[k] + H[7] * patch.v[k] + H[8]);
    float column = (H[0] * patch.u[k] + H[1] * patch.v[k] + H[2]) * scale;
    float row = (H[3] * patch.u[k] + H[4] * patch.v[k] + H[5]) * scale;
    // The order of the operands sends NaN (a sample behind the source) to the border.
    column = std::min(std::max(0.f, column), last_x);
    row = std::min(std::max(0.f, row), last_y);
    const int left = int(column), top = int(row);
    const uint32_t quad = quads[top * stride + left];  // one gather brings all four neighbours
    const float g00 = float(int(quad & 255)), g01 = float(int(quad >> 8 & 255));
    const float g10 = float(int(quad >> 16 & 255)), g11 = float(int(quad >> 24));
    const float right = column - float(left), down = row - float(top);
    const float upper = g00 + right * (g01 - g00), lower = g10 + right * (g11 - g10);
    const float value = upper + down * (lower - upper) - 128.f;  // centred: float32 keeps its digits in the variance
    mean += patch.weight[k] * value;
    square += patch.weight[k] * value * value;
    product += patch.weighted[k] * value;
  }
  const float variance = square - mean * mean;
  if (!(variance >= kMinVariance)) return kNoMatch;
  return std::min(kNoMatch, std::max(0.f, 1.f - product / std::sqrt(variance * patch.variance)));
}

// Forward-backward error in pixels: to the source by the plane, back by the source's own depth.
inline float reprojection_error(const Source& source, const Plane& plane, float u, float v) {
  const float q = plane.inverse_depth(u, v);
  const float* A = source.A;
  const float z = A[6] * u + A[7] * v + A[8] + source.k[2] * q;
  if (!(q > 0 && z > 1e-6f)) return kMaxReprojection;
  const float x = (A[0] * u + A[1] * v + A[2] + source.k[0] * q) / z;
  const float y = (A[3] * u + A[4] * v + A[5] + source.k[1] * q) / z;
  const float right = source.width - .5f, bottom = source.height - .5f;
  if (!(x > -.5f && y > -.5f && x < right && y < bottom)) return kMaxReprojection;
  const float depth = source.depth[size_t(int(y + .5f)) * source.width + int(x + .5f)];
  const float* B = source.back_A;
  const float back_z = (B[6] * x + B[7] * y + B[8]) * depth + source.back_k[2];
  if (!(depth > 0 && back_z > 1e-6f)) return kMaxReprojection;
  const float du = ((B[0] * x + B[1] * y + B[2]) * depth + source.back_k[0]) / back_z - u;
  const float dv = ((B[3] * x + B[4] * y + B[5]) * depth + source.back_k[1]) / back_z - v;
  return std::min(kMaxReprojection, std::sqrt(du * du + dv * dv));
}

}  // namespace d2
