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
struct Slopes {
  int32_t width, height, reach, threads;
  const float* depth;
  float *inverse, *slope_x, *slope_y;  // inverse depth, 0 where there is none, and its slopes per pixel
};

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
  double rays[9];               // from a reference pixel to its ray
  float continuous, reprojection_max, relative_depth_max;
  float sine_min, cosine_min, sine_max, cosine_max;  // of the angles between which rays may meet
  double nudge;                                      // factor of depth by which parallax is measured
  double nudge_squared;                              // of its logarithm
  const float *depth, *theirs;                       // 0 where there is none
  uint16_t* confirming;                              // how many sources confirmed: grows by one where this one does
  double *information, *difference;                  // sums of P^2, and of P^2 times the squared relative difference
};

namespace {

constexpr int kNoWeight = 256;    // where the table of weights has its zero
constexpr int kOutside = 100000;  // grey value that differs by more from every other

// The image with a rim of `radius` pixels on both sides of each row whose grey value weighs nothing, and room for
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

// The flatter of two one-sided differences of inverse depth; a side without depth has no say.
float slope(float before, float here, float after, float reach) {
  const float rise = before > 0 ? here - before : INFINITY, fall = after > 0 ? after - here : INFINITY;
  const float flatter = std::fabs(rise) < std::fabs(fall) ? rise : fall;
  return (std::fabs(flatter) < INFINITY && here > 0 ? flatter : 0) / reach;
}

void slopes_of_row(const Slopes& c, int row) {
  const int64_t first = int64_t(row) * c.width, step = int64_t(c.reach) * c.width;
  const std::vector<float> nothing(c.width);
  const float *here = c.inverse + first, *above = row >= c.reach ? here - step : nothing.data();
  const float* below = row + c.reach < c.height ? here + step : nothing.data();
  std::vector<float> rimmed(c.width + 2 * c.reach);
  std::copy_n(here, c.width, rimmed.data() + c.reach);
  const float *left = rimmed.data(), *right = left + 2 * c.reach, reach = float(c.reach);
  float *__restrict__ x = c.slope_x + first, *__restrict__ y = c.slope_y + first;
  for (int i = 0; i < c.width; i++) x[i] = slope(left[i], here[i], right[i], reach);
  for (int i = 0; i < c.width; i++) y[i] = slope(above[i], here[i], below[i], reach);
}

// Reference pixel (u, v) at a depth -> where it lands; behind the camera at infinity's place, 0.
template <class T>
void project(const T* A, const T* k, T u, T v, T depth, T* x, T* y, T* z) {
  *z = depth * (A[6] * u + A[7] * v + A[8]) + k[2];
  const T safe = *z > 0 ? *z : T(INFINITY);
  *x = (depth * (A[0] * u + A[1] * v + A[2]) + k[0]) / safe;
  *y = (depth * (A[3] * u + A[4] * v + A[5]) + k[1]) / safe;
}

// The pixels of a row that have a depth, packed: `count` of `width`. Each step is a plain loop over them, which
// compilers turn into vectors, but for the one that reads the source's map.
class Row {
 public:
  Row(const Confirm& call, int row)
      : c(call), first(int64_t(row) * call.width), v(float(row)), columns(call.width), floats(size_t(call.width) * 12),
        doubles(size_t(call.width) * 4) {
    for (int column = 0; column < c.width; column++) {
      if (!(c.depth[first + column] > 0)) continue;
      columns[count] = column, u()[count] = float(column), depth()[count] = c.depth[first + column];
      count++;
    }
  }

  void confirm() {
    land();
    look();
    read();
    return_to_us();
    for (int i = 0; i < count; i++) {
      if (!agrees()[i]) continue;
      const int64_t pixel = first + columns[i];
      c.confirming[pixel]++;
      c.information[pixel] += precision()[i];
      c.difference[pixel] += difference()[i];
    }
  }

 private:
  // Where the points land in the source.
  void land() {
    float A[9], k[3];
    std::copy(c.A, c.A + 9, A), std::copy(c.k, c.k + 3, k);
    float *u_ = u(), *depth_ = depth(), *x_ = x(), *y_ = y(), *z_ = z();
    for (int i = 0; i < count; i++) project(A, k, u_[i], v, depth_[i], x_ + i, y_ + i, z_ + i);
  }

  // What lies there: the four pixels around a place where they are one surface, else the nearest four times.
  void look() {
    const int width = c.their_width, height = c.their_height;
    const bool surfaces = c.between && std::min(width, height) > 1;
    for (int i = 0; i < count; i++) {
      const float x_ = x()[i], y_ = y()[i];
      const bool near = z()[i] > 0 && x_ > -0.5f && y_ > -0.5f && x_ < width - 0.5f && y_ < height - 0.5f;
      if (surfaces && near && x_ >= 0 && y_ >= 0 && x_ <= width - 1 && y_ <= height - 1) {
        const int left = std::min(int(x_), width - 2), top = std::min(int(y_), height - 2);
        const float* corner = c.theirs + size_t(top) * width + left;
        const float a = corner[0], b = corner[1], d = corner[width], e = corner[width + 1];
        const float low = std::min(std::min(a, b), std::min(d, e)), high = std::max(std::max(a, b), std::max(d, e));
        if (low > 0 && high < c.continuous * low) {
          corners(0)[i] = a, corners(1)[i] = b, corners(2)[i] = d, corners(3)[i] = e;
          right()[i] = double(x_) - left, down()[i] = double(y_) - top;
          continue;
        }
      }
      // One depth four times is itself between them, but for rounding: it is taken as it is.
      right()[i] = -1;
      corners(0)[i] = near ? c.theirs[size_t(std::nearbyint(y_)) * width + size_t(std::nearbyint(x_))] : 0;
      corners(1)[i] = corners(2)[i] = corners(3)[i] = 1, down()[i] = 0;
    }
  }

  // The source's depth at those places, 0 where it has none.
  void read() {
    const float *a = corners(0), *b = corners(1), *d = corners(2), *e = corners(3);
    const double *right_ = right(), *down_ = down();
    float* seen_ = seen();
    for (int i = 0; i < count; i++) {
      const double upper = 1 / double(a[i]) * (1 - right_[i]) + 1 / double(b[i]) * right_[i];
      const double lower = 1 / double(d[i]) * (1 - right_[i]) + 1 / double(e[i]) * right_[i];
      const float between = float(1 / (upper * (1 - down_[i]) + lower * down_[i]));
      seen_[i] = right_[i] < 0 ? a[i] : between;
    }
  }

  // Whether the source's depth takes us back to where we came from, by rays that meet at an angle that is allowed, and
  // what it says then. |a x b| and a.b are that angle's sine and cosine times the same length; in units of the depth,
  // so that no unit of the world overflows.
  void return_to_us() {
    const float *u_ = u(), *depth_ = depth(), *x_ = x(), *y_ = y(), *seen_ = seen();
    int32_t* agrees_ = agrees();
    double *precision_ = precision(), *difference_ = difference();
    const double row = v, *K = c.rays;
    for (int i = 0; i < count; i++) {
      float back_x, back_y, back_z;
      project(c.back_A, c.back_k, x_[i], y_[i], seen_[i], &back_x, &back_y, &back_z);
      const float off_x = back_x - u_[i], off_y = back_y - v;
      const bool returns = (std::sqrt(off_x * off_x + off_y * off_y) < c.reprojection_max) &
                           (std::fabs(back_z - depth_[i]) < c.relative_depth_max * depth_[i]);
      const double column = u_[i];
      const float ray_x = float(K[0] * column + K[1] * row + K[2]), ray_y = float(K[3] * column + K[4] * row + K[5]);
      const float ray_z = float(K[6] * column + K[7] * row + K[8]);
      const float s = ray_x - c.direction[0] / depth_[i], t = ray_y - c.direction[1] / depth_[i];
      const float w = ray_z - c.direction[2] / depth_[i];
      const float p = ray_y * w - ray_z * t, q = ray_z * s - ray_x * w, r = ray_x * t - ray_y * s;
      const float sine = std::sqrt(p * p + q * q + r * r), cosine = ray_x * s + ray_y * t + ray_z * w;
      const bool meets =
          (sine * c.cosine_min > cosine * c.sine_min) & (sine * c.cosine_max < cosine * c.sine_max);
      agrees_[i] = (seen_[i] > 0) & returns & meets;
      double nudged_x, nudged_y, nudged_z;
      project(c.A, c.k, column, row, double(depth_[i]) * c.nudge, &nudged_x, &nudged_y, &nudged_z);
      const double moved_x = nudged_x - double(x_[i]), moved_y = nudged_y - double(y_[i]);
      const double squared = (moved_x * moved_x + moved_y * moved_y) / c.nudge_squared;
      precision_[i] = squared < INFINITY ? squared : 0;
      const float apart = back_z / depth_[i] - 1;
      difference_[i] = precision_[i] * double(apart * apart);
    }
  }

  float* part(int index) { return floats.data() + size_t(index) * c.width; }
  float* u() { return part(0); }
  float* depth() { return part(1); }
  float* x() { return part(2); }
  float* y() { return part(3); }
  float* z() { return part(4); }
  float* seen() { return part(5); }
  float* corners(int index) { return part(6 + index); }
  int32_t* agrees() { return reinterpret_cast<int32_t*>(part(10)); }
  double* right() { return doubles.data(); }
  double* down() { return right() + c.width; }
  double* precision() { return down() + c.width; }
  double* difference() { return precision() + c.width; }

  const Confirm& c;
  const int64_t first;
  const float v;
  int count = 0;
  std::vector<int> columns;
  std::vector<float> floats;
  std::vector<double> doubles;
};

}  // namespace
}  // namespace d2

extern "C" {

int64_t d2_slopes_size() { return sizeof(d2::Slopes); }
int64_t d2_coherence_size() { return sizeof(d2::Coherence); }
int64_t d2_confirm_size() { return sizeof(d2::Confirm); }

void d2_slopes(const d2::Slopes* call) {
  const int64_t pixels = int64_t(call->width) * call->height;
  for (int64_t i = 0; i < pixels; i++) call->inverse[i] = call->depth[i] > 0 ? 1 / call->depth[i] : 0;
  d2::parallel_for(call->threads, call->height, [&](int64_t row) { d2::slopes_of_row(*call, int(row)); });
}

void d2_coherence(const d2::Coherence* call) {
  const d2::Rimmed rimmed(*call);
  d2::parallel_for(call->threads, call->height, [&](int64_t row) { d2::coherence_of_row(*call, rimmed, int(row)); });
}

void d2_confirm(const d2::Confirm* call) {
  d2::parallel_for(call->threads, call->height, [&](int64_t row) { d2::Row(*call, int(row)).confirm(); });
}
}
