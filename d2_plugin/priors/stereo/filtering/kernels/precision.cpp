// How precise a geometric depth is: its scatter about the plane of its window, and its sigma.
//
// The same operations in the same order as the NumPy code of precision.py, nothing contracted: both return the same
// bits, for any number of threads. Plain loops over columns, which compilers turn into vectors.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "parallel.h"

namespace d2 {

// What one call works on, as kernel.py fills it in; maps are [height, width].
struct Scatter {
  int32_t width, height, reach, threads;
  double slack;        // added to the moments, pixels^2: a window of one row has no slope across it
  const float* depth;  // 0 where there is none
  double* scatter;
};

struct Sigma {
  int32_t width, height, threads;
  float matching, gray_noise, flattest, per_incoherence;
  double of_scatter, of_spread, floor_squared;
  const float *depth, *coherence, *gradient;
  const double *parallax, *spread, *scatter;
  float* sigma;
};

namespace {

// Sums over the columns of a window, for each column of the image and `reach` empty ones on both sides: of the weight
// and of inverse depth y, each times powers of the row v, counted from the window's middle.
struct Columns {
  std::vector<float> weights[3];    // of 1, v and v^2: whole numbers, exact
  std::vector<double> inverses[3];  // of y, v y and y^2

  explicit Columns(int size) {
    for (auto& sums : weights) sums.resize(size);
    for (auto& sums : inverses) sums.resize(size);
  }

  void add(int width, int reach, float v, const double* __restrict__ inverse) {
    float* __restrict__ w = weights[0].data() + reach;
    float* __restrict__ vw = weights[1].data() + reach;
    float* __restrict__ vvw = weights[2].data() + reach;
    double* __restrict__ y = inverses[0].data() + reach;
    double* __restrict__ vy = inverses[1].data() + reach;
    double* __restrict__ yy = inverses[2].data() + reach;
    const double by = v;
    for (int x = 0; x < width; x++) {
      y[x] += inverse[x];
      vy[x] += by * inverse[x];
      yy[x] += inverse[x] * inverse[x];
    }
    for (int x = 0; x < width; x++) {
      const float weight = inverse[x] > 0 ? 1 : 0;
      w[x] += weight;
      vw[x] += v * weight;
      vvw[x] += v * v * weight;
    }
  }
};

// Sum over a window, [width], of a column's sums times a power of the column u.
template <class T, int POWER>
void across(int width, int reach, const std::vector<T>& from, T* __restrict__ sum) {
  std::fill(sum, sum + width, T(0));
  for (int offset = -reach; offset <= reach; offset++) {
    const T* __restrict__ there = from.data() + reach + offset;
    const T by = POWER == 0 ? T(1) : POWER == 1 ? T(offset) : T(offset) * T(offset);
    for (int x = 0; x < width; x++) sum[x] += by * there[x];
  }
}

void scatter_of_row(const Scatter& c, const double* inverse, int row) {
  const int width = c.width, reach = c.reach;
  Columns columns(width + 2 * reach);
  for (int v = std::max(-reach, -row); v <= std::min(reach, c.height - 1 - row); v++) {
    columns.add(width, reach, float(v), inverse + int64_t(row + v) * width);
  }
  std::vector<float> whole(size_t(width) * 6);
  std::vector<double> real(size_t(width) * 4);
  float *n = whole.data(), *u = n + width, *uu = u + width, *v = uu + width, *uv = v + width, *vv = uv + width;
  double *y = real.data(), *uy = y + width, *vy = uy + width, *yy = vy + width;
  across<float, 0>(width, reach, columns.weights[0], n);
  across<float, 1>(width, reach, columns.weights[0], u);
  across<float, 2>(width, reach, columns.weights[0], uu);
  across<float, 0>(width, reach, columns.weights[1], v);
  across<float, 1>(width, reach, columns.weights[1], uv);
  across<float, 0>(width, reach, columns.weights[2], vv);
  across<double, 0>(width, reach, columns.inverses[0], y);
  across<double, 1>(width, reach, columns.inverses[0], uy);
  across<double, 0>(width, reach, columns.inverses[1], vy);
  across<double, 0>(width, reach, columns.inverses[2], yy);
  const double* own = inverse + int64_t(row) * width;
  double* __restrict__ scatter = c.scatter + int64_t(row) * width;
  for (int x = 0; x < width; x++) {
    const double share = 1 / std::max(double(n[x]), 1.0);  // one division for ten
    const double mean_u = u[x] * share, mean_v = v[x] * share, mean_y = y[x] * share;
    const double of_uu = uu[x] * share - mean_u * mean_u + c.slack, of_vv = vv[x] * share - mean_v * mean_v + c.slack;
    const double of_uv = uv[x] * share - mean_u * mean_v, of_yy = yy[x] * share - mean_y * mean_y;
    const double of_uy = uy[x] * share - mean_u * mean_y, of_vy = vy[x] * share - mean_v * mean_y;
    const double determinant = of_uu * of_vv - of_uv * of_uv;
    const double explained =
        (of_vv * of_uy * of_uy - 2 * of_uv * of_uy * of_vy + of_uu * of_vy * of_vy) / determinant;
    const double left = std::sqrt(std::max(of_yy - explained, 0.0));
    scatter[x] = own[x] > 0 ? left / own[x] : 0;
  }
}

void sigma_of_row(const Sigma& c, int row) {
  float* __restrict__ sigma = c.sigma;
  const int64_t first = int64_t(row) * c.width, end = first + c.width;
  for (int64_t i = first; i < end; i++) {
    const float depth = c.depth[i], coherence = c.coherence[i], gradient = c.gradient[i];
    const bool known = (depth > 0) & (depth < INFINITY) & (c.parallax[i] > 0) & (std::fabs(c.spread[i]) < INFINITY) &
                       (coherence == coherence) & (gradient == gradient);
    float pixels = c.matching + c.gray_noise / std::max(gradient, c.flattest);
    pixels = pixels + c.per_incoherence * (1 - std::min(std::max(coherence, 0.f), 1.f));
    const double matching = pixels / c.parallax[i], scatter = c.of_scatter * c.scatter[i];
    const double spread = c.of_spread * c.spread[i];
    const double variance = matching * matching + scatter * scatter + spread * spread + c.floor_squared;
    sigma[i] = known ? float(std::sqrt(variance)) : std::numeric_limits<float>::infinity();
  }
}

}  // namespace
}  // namespace d2

extern "C" {

int64_t d2_scatter_size() { return sizeof(d2::Scatter); }
int64_t d2_sigma_size() { return sizeof(d2::Sigma); }

void d2_scatter(const d2::Scatter* call) {
  const int64_t width = call->width;
  std::vector<double> inverse(size_t(width) * call->height);
  d2::parallel_for(call->threads, call->height, [&](int64_t row) {
    const float* depth = call->depth + row * width;
    for (int64_t x = 0; x < width; x++) inverse[row * width + x] = depth[x] > 0 ? 1 / double(depth[x]) : 0;
  });
  d2::parallel_for(call->threads, call->height,
                   [&](int64_t row) { d2::scatter_of_row(*call, inverse.data(), int(row)); });
}

void d2_sigma(const d2::Sigma* call) {
  d2::parallel_for(call->threads, call->height, [&](int64_t row) { d2::sigma_of_row(*call, int(row)); });
}
}
