// The two tests of the filter of geometric depth that ask many pixels: surface coherence and confirmation by a source.
//
// The same operations in the same order as the NumPy code of coherence.py and confirm.py, nothing contracted: both
// return the same bits, for any number of threads.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "lanes.h"
#include "parallel.h"

namespace d2 {

// What one call works on, as kernel.py fills it in; maps are [height, width].
struct Coherence {
  int32_t width, height, radius, stride, threads;
  float relative;
  const uint8_t* gray;
  const float *inverse, *slope_x, *slope_y;  // inverse depth, 0 where there is none, and its slopes
  const float* weights;                      // [257], by the difference of grey values; the last is 0
  float* share;
};

struct Confirm {
  int32_t width, height, their_width, their_height, between, threads;
  double A[9], k[3];            // from the reference to the source
  float back_A[9], back_k[3];   // and back
  float direction[3];           // the source's centre as the reference sees it
  float continuous, reprojection_max, relative_depth_max;
  float sine_min, cosine_min, sine_max, cosine_max;  // of the angles between which rays may meet
  double nudge;                                      // factor of depth by which parallax is measured
  double nudge_squared;                              // of its logarithm
  const float *rays, *depth, *theirs;                // rays [height, width, 3]; depths are 0 where there is none
  uint8_t* confirming;                               // how many sources confirmed: grows by one where this one does
  double *information, *difference;                  // sums of P^2, and of P^2 times the squared relative difference
};

namespace {

constexpr int kNoWeight = 256;    // where the table of weights has its zero
constexpr int kOutside = 100000;  // grey value that differs by more from every other

// The picture with a rim of `radius` pixels on both sides of each row whose grey value weighs nothing, and room for
// whole vectors at its end.
struct Rimmed {
  int stride;
  std::vector<int32_t> gray;
  std::vector<float> inverse;

  explicit Rimmed(const Coherence& c)
      : stride(c.width + 2 * c.radius + kLanes), gray(size_t(c.height) * stride, kOutside), inverse(gray.size()) {
    for (int y = 0; y < c.height; y++) {
      const size_t to = size_t(y) * stride + c.radius, from = size_t(y) * c.width;
      std::copy_n(c.gray + from, c.width, gray.data() + to);
      std::copy_n(c.inverse + from, c.width, inverse.data() + to);
    }
  }
};

void coherence_of_row(const Coherence& c, const Rimmed& rimmed, int y) {
  const Floats zero{}, tiny = zero + std::numeric_limits<float>::min(), relative = zero + c.relative;
  const Integers outside = Integers{} + kNoWeight;
  for (int x = 0; x < c.width; x += kLanes) {
    const size_t place = size_t(y) * rimmed.stride + c.radius + x, pixel = size_t(y) * c.width + x;
    const size_t bytes = sizeof(float) * std::min(kLanes, c.width - x);
    Floats slope_x{}, slope_y{}, total{}, agreeing{};
    std::memcpy(&slope_x, c.slope_x + pixel, bytes), std::memcpy(&slope_y, c.slope_y + pixel, bytes);
    const Integers gray = load<Integers>(rimmed.gray.data() + place);
    const Floats inverse = load<Floats>(rimmed.inverse.data() + place), tolerance = relative * inverse;
    for (int dy = -c.radius; dy <= c.radius; dy += c.stride) {
      if (y + dy < 0 || y + dy >= c.height) continue;
      for (int dx = -c.radius; dx <= c.radius; dx += c.stride) {
        if (!dx && !dy) continue;
        const size_t there = place + ptrdiff_t(dy) * rimmed.stride + dx;
        Integers apart = load<Integers>(rimmed.gray.data() + there) - gray;
        apart = apart < 0 ? -apart : apart;
        apart = apart > outside ? outside : apart;
        const Floats weight = bits_float(look_up(reinterpret_cast<const unsigned*>(c.weights), apart));
        Floats distance = load<Floats>(rimmed.inverse.data() + there) - inverse;
        distance -= float(dx) * slope_x;
        distance -= float(dy) * slope_y;
        distance = distance < zero ? -distance : distance;
        total += weight;
        agreeing += distance < tolerance ? weight : zero;
      }
    }
    const Floats share = agreeing / larger(total, tiny);
    std::memcpy(c.share + pixel, &share, bytes);
  }
}

struct Place {
  float x, y, z;
};

// Reference pixel (u, v) at a depth -> where it lands; behind the camera at infinity's place, 0.
template <class T>
void project(const T* A, const T* k, T u, T v, T depth, T* x, T* y, T* z) {
  *z = depth * (A[6] * u + A[7] * v + A[8]) + k[2];
  const T safe = *z > 0 ? *z : T(INFINITY);
  *x = (depth * (A[0] * u + A[1] * v + A[2]) + k[0]) / safe;
  *y = (depth * (A[3] * u + A[4] * v + A[5]) + k[1]) / safe;
}

float nearest(const Confirm& c, Place at) {
  const int width = c.their_width, height = c.their_height;
  const bool inside = at.z > 0 && at.x > -0.5f && at.y > -0.5f && at.x < width - 0.5f && at.y < height - 0.5f;
  if (!inside) return 0;
  return c.theirs[size_t(std::nearbyint(at.y)) * width + size_t(std::nearbyint(at.x))];
}

// Depth between the four pixels around a place where they are one surface; 0 elsewhere.
float between(const Confirm& c, Place at) {
  const int width = c.their_width, height = c.their_height;
  const bool inside = at.z > 0 && at.x >= 0 && at.y >= 0 && at.x <= width - 1 && at.y <= height - 1;
  if (std::min(width, height) < 2 || !inside) return 0;
  const int left = std::min(int(std::floor(at.x)), width - 2), top = std::min(int(std::floor(at.y)), height - 2);
  const double right = double(at.x) - left, down = double(at.y) - top;
  const float* corner = c.theirs + size_t(top) * width + left;
  const float a = corner[0], b = corner[1], d = corner[width], e = corner[width + 1];
  const float low = std::min(std::min(a, b), std::min(d, e)), high = std::max(std::max(a, b), std::max(d, e));
  if (!(low > 0 && high < c.continuous * low)) return 0;
  const double upper = 1 / double(a) * (1 - right) + 1 / double(b) * right;
  const double lower = 1 / double(d) * (1 - right) + 1 / double(e) * right;
  return float(1 / (upper * (1 - down) + lower * down));
}

// Whether the rays of both cameras to a point meet at an angle that is allowed: |a x b| and a.b are its sine and cosine
// times the same length. In units of the depth, so that no unit of the world overflows.
bool meets(const Confirm& c, const float* ray, float depth) {
  const float x = ray[0], y = ray[1], z = ray[2];
  const float u = x - c.direction[0] / depth, v = y - c.direction[1] / depth, w = z - c.direction[2] / depth;
  const float p = y * w - z * v, q = z * u - x * w, r = x * v - y * u;
  const float sine = std::sqrt(p * p + q * q + r * r), cosine = x * u + y * v + z * w;
  return sine * c.cosine_min > cosine * c.sine_min && sine * c.cosine_max < cosine * c.sine_max;
}

void confirm_row(const Confirm& c, int row) {
  float A[9], k[3];
  std::copy(c.A, c.A + 9, A), std::copy(c.k, c.k + 3, k);
  for (int column = 0; column < c.width; column++) {
    const size_t pixel = size_t(row) * c.width + column;
    const float depth = c.depth[pixel], u = float(column), v = float(row);
    if (!(depth > 0)) continue;
    Place forth, back;
    project(A, k, u, v, depth, &forth.x, &forth.y, &forth.z);
    float seen = c.between ? between(c, forth) : 0;
    if (!(seen > 0)) seen = nearest(c, forth);
    if (!(seen > 0)) continue;
    project(c.back_A, c.back_k, forth.x, forth.y, seen, &back.x, &back.y, &back.z);
    const float off_x = back.x - u, off_y = back.y - v;
    if (!(std::sqrt(off_x * off_x + off_y * off_y) < c.reprojection_max)) continue;
    if (!(std::fabs(back.z - depth) < c.relative_depth_max * depth)) continue;
    if (!meets(c, c.rays + 3 * pixel, depth)) continue;
    double x, y, z;
    project(c.A, c.k, double(u), double(v), double(depth) * c.nudge, &x, &y, &z);
    const double moved_x = x - double(forth.x), moved_y = y - double(forth.y);
    const double squared = (moved_x * moved_x + moved_y * moved_y) / c.nudge_squared;
    const double precision = std::isfinite(squared) ? squared : 0;
    const float apart = back.z / depth - 1;
    c.confirming[pixel]++;
    c.information[pixel] += precision;
    c.difference[pixel] += precision * double(apart * apart);
  }
}

}  // namespace
}  // namespace d2

extern "C" {

int64_t d2_coherence_size() { return sizeof(d2::Coherence); }
int64_t d2_confirm_size() { return sizeof(d2::Confirm); }

void d2_coherence(const d2::Coherence* call) {
  const d2::Rimmed rimmed(*call);
  d2::parallel_for(call->threads, call->height, [&](int64_t row) { d2::coherence_of_row(*call, rimmed, int(row)); });
}

void d2_confirm(const d2::Confirm* call) {
  d2::parallel_for(call->threads, call->height, [&](int64_t row) { d2::confirm_row(*call, int(row)); });
}
}
