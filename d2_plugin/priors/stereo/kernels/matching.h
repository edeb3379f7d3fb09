// How well a plane explains the images: bilaterally weighted NCC between a window of the reference and a source.
#pragma once

#include "planes.h"

namespace d2 {

constexpr int kSamples = 32;            // of a window: a 6 x 6 grid over 11 x 11 pixels without its corners
constexpr int kPartials = 16;           // sums over a window are added up in this many places, then in pairs
constexpr float kNoMatch = 2.f;         // the worst 1 - NCC: outside of the source, behind it, or without texture
constexpr float kMinVariance = 0.65f;   // grey levels squared (1e-5 in 0..1): below it NCC correlates rounding errors
constexpr float kPerSquare = -kLog2E / 18.f;  // log2 of the weight per squared distance: standard deviation 3 pixels

extern "C" {

// A source view as the reference sees it: pixel p of the reference at inverse depth q is at A p + k q in the source.
struct Source {
  int width, height;
  int first;                   // its first place in Task.quads
  float A[9], k[3];
};

}  // extern "C"

// Column and row of sample k relative to the middle: odd numbers from -5 to 5, row by row.
D2_FN int sample_place(int k) { return k < 4 ? k + 1 : k < 28 ? k + 2 : k + 3; }  // in the 6 x 6 grid
D2_FN int sample_du(int k) { return 2 * (sample_place(k) % 6) - 5; }
D2_FN int sample_dv(int k) { return 2 * (sample_place(k) / 6) - 5; }

// log2 of a sample's weight over distance. Divided by their sum, weights over distance and grey value are those of the
// window: 2^(log2 over distance + per_gray difference^2).
D2_FN float log2_spatial(int du, int dv) { return float(du * du + dv * dv) * kPerSquare; }

template <class S>
D2_FN S sum_of_partials(const S* part) {
  S sum[kPartials];
  for (int k = 0; k < kPartials; k++) sum[k] = part[k];
  for (int half = kPartials / 2; half > 0; half /= 2)
    for (int k = 0; k < half; k++) sum[k] += sum[k + half];
  return sum[0];
}

// Where a plane puts the window around a pixel in a source: (x, y) for its middle, and for a sample at (du, dv)
//   (x, y) + (xu du + xv dv, yu du + yv dv) / (1 + zu du + zv dv).
template <class S>
struct Warp {
  S x, y, xu, xv, yu, yv, zu, zv;
  S seen;  // 1, or 0 where the middle lies behind or outside of the source
};

template <class S>
D2_FN Warp<S> warp_of(const S (&A)[9], const S (&k)[3], S width, S height, S a, S b, S c, S u, S v) {
  const S zero = all<S>(0.f);
  const S h0 = mad(k[0], a, A[0]), h1 = mad(k[0], b, A[1]), h2 = mad(k[0], c, A[2]);
  const S h3 = mad(k[1], a, A[3]), h4 = mad(k[1], b, A[4]), h5 = mad(k[1], c, A[5]);
  const S h6 = mad(k[2], a, A[6]), h7 = mad(k[2], b, A[7]), h8 = mad(k[2], c, A[8]);
  const S z = mad(h6, u, mad(h7, v, h8)), inverse = 1.f / larger(z, all<S>(1e-6f));
  const S found_x = mad(h0, u, mad(h1, v, h2)) * inverse;
  const S found_y = mad(h3, u, mad(h4, v, h5)) * inverse;
  const auto inside = (found_x >= 0.f) & (found_y >= 0.f) & (found_x <= width - 1.f) & (found_y <= height - 1.f);
  const auto seen = (z > 1e-6f) & inside;
  const S factor = pick(seen, inverse, zero);  // nothing but zeros where there is nothing to see
  const S x = pick(seen, found_x, zero), y = pick(seen, found_y, zero), zu = h6 * factor, zv = h7 * factor;
  return {x, y, mad(-zu, x, h0 * factor), mad(-zv, x, h1 * factor), mad(-zu, y, h3 * factor), mad(-zv, y, h4 * factor),
          zu, zv, pick(seen, all<S>(1.f), zero)};
}

// What the samples of one row of a window have in common.
template <class S>
struct Line {
  S x, y, z;
};
template <class S>
D2_FN Line<S> line_of(const Warp<S>& warp, S dv) { return {warp.xv * dv, warp.yv * dv, warp.zv * dv}; }

// Sums over a window of the source.
template <class S>
struct Sums {
  S mean, square, product;

  // Adds one sample, read from quads[first + row * stride + column]. The division is a series: what it leaves out is the
  // fourth power of the relative change of depth over half a window, .0005 pixels at a tenth. `bounded` says that the
  // window does not leave the source, so that nothing need be clamped.
  template <bool bounded, class I>
  D2_FN void add(const unsigned* quads, I first, I stride, S last_x, S last_y, const Warp<S>& warp, const Line<S>& line,
                 S du, S weight, S weighted) {
    const S e = mad(warp.zu, du, line.z), rest = 1.f - e, scale = mad(e * e, rest, rest);
    S column = mad(mad(warp.xu, du, line.x), scale, warp.x), row = mad(mad(warp.yu, du, line.y), scale, warp.y);
    if (!bounded) {
      column = smaller(larger(column, all<S>(0.f)), last_x);
      row = smaller(larger(row, all<S>(0.f)), last_y);
    }
    const I left = whole(column), top = whole(row);
    const Corners<S> g = corners_of(look_up(quads, first + top * stride + left));  // one access brings all four
    const S right = column - real(left), down = row - real(top);
    const S upper = mad(right, g.upper_step, g.upper), lower = mad(right, g.lower_step, g.lower);
    const S value = mad(down, lower - upper, upper) - 128.f;  // centred: float32 keeps its digits in the variance
    const S part = weight * value;
    mean += part;
    square = mad(part, value, square);
    product = mad(weighted, value, product);
  }

  // 1 - NCC in 0..2; variance is that of the reference.
  D2_FN S cost(S variance, S seen) const {
    const S theirs = mad(-mean, mean, square), worst = all<S>(kNoMatch);
    const auto told = (seen > 0.f) & (theirs >= kMinVariance) & (variance >= kMinVariance);
    const S ncc = product / root(pick(told, theirs * variance, all<S>(1.f)));
    return pick(told, smaller(larger(1.f - ncc, all<S>(0.f)), worst), worst);
  }
};

// The largest column or row that a sample is read at: its right and lower neighbour lie in its quad.
D2_FN float last_place(int size) { return larger(float(size) - 1.001f, 0.f); }

}  // namespace d2
