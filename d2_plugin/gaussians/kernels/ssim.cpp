// The photometric loss (1 - w) mean |a - b| + w (1 - mean SSIM(a, b)) and its gradient with respect to a, in one walk
// over the rows: what photometric.py does in torch.
//
// Pictures stay as they are, [H, W, C] with channels interleaved: a step of one pixel is a step of C numbers. A row of
// SSIM needs 11 rows of the pictures, blurred down the columns and then along the row; a row of the gradient needs 11
// rows of the derivatives of SSIM, which wait in a ring. Sums over a row are added up in the order of rows, so results
// are the same bits for any number of threads.
#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "parallel.h"
#include "simd.h"

namespace d2 {

constexpr int RADIUS = 5, TAPS = 2 * RADIUS + 1;
constexpr float C1 = 0.01f * 0.01f, C2 = 0.03f * 0.03f;

// Variances are differences of nearly equal numbers where a picture is flat. They do not change if both pictures, and
// the zeros around them, are shifted; numbers in -1/2..1/2 leave a quarter of the rounding.
constexpr float SHIFT = 0.5f;

// What one call works on, as native_ssim.py fills it in.
struct Photometric {
  int32_t height, width, channels, threads;
  float ssim_weight;
  float window[TAPS];
  const float *image, *target;         // [H, W, C]
  float* gradient;                     // [H, W, C] or null
  double *differences, *similarities;  // [H] sums over each row

  int64_t row_length() const { return int64_t(width) * channels; }
};

// A picture's row from number x on; zeros beyond its end.
D2_INLINE Floats load_row(const float* row, int64_t x, int64_t length) {
  if (x + LANES <= length) return Floats::load(row + x);
  alignas(64) float lane[LANES] = {};
  std::memcpy(lane, row + x, sizeof(float) * (length - x));
  return Floats::load(lane);
}

// Sum over 11 values weighted by the window, which is symmetric: small weights first, for less rounding.
template <class Value>
D2_INLINE Floats blur(const float* window, Value value) {
  Floats total = Floats(window[0]) * (value(0) + value(TAPS - 1));
  for (int t = 1; t < RADIUS; t++) total = fma(Floats(window[t]), value(t) + value(TAPS - 1 - t), total);
  return fma(Floats(window[RADIUS]), value(RADIUS), total);
}

// Rows begin..end-1 of the gradient, with the buffers for them.
class Band {
 public:
  Band(const Photometric& p, int begin, int end)
      : p_(p), begin_(begin), end_(end), length_(p.row_length()), margin_(int64_t(RADIUS) * p.channels),
        whole_((length_ + LANES - 1) / LANES * LANES), padded_(whole_ + 2 * margin_) {
    static thread_local std::vector<float> memory;
    memory.assign(size_t((5 + 3) * padded_ + (3 * TAPS + 1) * whole_), 0.f);
    blurred_ = memory.data();
    derivatives_ = blurred_ + 5 * padded_;
    ring_ = derivatives_ + 3 * padded_;
    zeros_ = ring_ + 3 * TAPS * whole_;
    for (int m = 0; m < 5; m++) std::fill_n(blurred_ + m * padded_, padded_, m < 2 ? -SHIFT : SHIFT * SHIFT);
  }

  void run() {
    const int reach = p_.gradient ? RADIUS : 0;
    int next = begin_;
    for (int y = std::max(0, begin_ - reach); y < std::min(p_.height, end_ + reach); y++) {
      blur_columns(y);
      const double similarity = compare(y);
      if (y >= begin_ && y < end_) p_.similarities[y] = similarity;
      for (; next < end_ && std::min(next + reach, p_.height - 1) <= y; next++) finish(next);
    }
  }

 private:
  const float* row_of(const float* picture, int y) const {
    return y >= 0 && y < p_.height ? picture + y * length_ : zeros_;
  }
  float* ring_row(int map, int y) const { return ring_ + (map * TAPS + y % TAPS) * whole_; }

  // Along a padded row, from the pixel five to the left.
  Floats blur_along(const float* from) const {
    return blur(p_.window, [&](int t) { return Floats::load(from + int64_t(t) * p_.channels); });
  }

  // Blurs a, b, a a, b b and a b down the columns around row y.
  void blur_columns(int y) {
    const float *a[TAPS], *b[TAPS];
    for (int t = 0; t < TAPS; t++) a[t] = row_of(p_.image, y + t - RADIUS), b[t] = row_of(p_.target, y + t - RADIUS);
    for (int64_t x = 0; x < length_; x += LANES) {
      Floats sums[5] = {0.f, 0.f, 0.f, 0.f, 0.f};
      const auto add = [&](int t, const Floats(&values)[5]) {
        for (int m = 0; m < 5; m++) sums[m] = fma(Floats(p_.window[t]), values[m], sums[m]);
      };
      const auto load = [&](const float* row) { return load_row(row, x, length_) - Floats(SHIFT); };
      for (int t = 0; t < RADIUS; t++) {
        const Floats a0 = load(a[t]), b0 = load(b[t]), a1 = load(a[TAPS - 1 - t]), b1 = load(b[TAPS - 1 - t]);
        add(t, {a0 + a1, b0 + b1, a0 * a0 + a1 * a1, b0 * b0 + b1 * b1, a0 * b0 + a1 * b1});
      }
      const Floats a0 = load(a[RADIUS]), b0 = load(b[RADIUS]);
      add(RADIUS, {a0, b0, a0 * a0, b0 * b0, a0 * b0});
      for (int m = 0; m < 5; m++) sums[m].store(blurred_ + m * padded_ + margin_ + x);
    }
  }

  // Sum of SSIM over row y; its derivatives by mean_a, aa and ab, blurred along the row, go to the ring.
  double compare(int y) {
    double total = 0;
    for (int64_t x = 0; x < length_; x += LANES) {
      Floats maps[5];
      for (int m = 0; m < 5; m++) maps[m] = blur_along(blurred_ + m * padded_ + x);
      const Floats shifted_a = maps[0], shifted_b = maps[1], two = 2.f, c1 = C1, c2 = C2;
      const Floats mean_a = shifted_a + Floats(SHIFT), mean_b = shifted_b + Floats(SHIFT);
      const Floats variances = maps[2] - shifted_a * shifted_a + (maps[3] - shifted_b * shifted_b);
      const Floats means_match = two * mean_a * mean_b + c1, means_size = mean_a * mean_a + mean_b * mean_b + c1;
      const Floats match = two * (maps[4] - shifted_a * shifted_b) + c2, size = variances + c2;
      const Floats inverse = Floats(1.f) / (means_size * size);
      const Floats similarity = means_match * match * inverse;
      alignas(64) float lane[LANES];
      similarity.store(lane);
      const int here = int(std::min<int64_t>(LANES, length_ - x));
      for (int i = 0; i < here; i++) total += lane[i];
      if (!p_.gradient) continue;
      const Floats by_aa = -similarity * (means_size * inverse), by_ab = two * means_match * inverse;
      const Floats by_mean = two * (mean_b * match * inverse - mean_a * similarity * (size * inverse)) -
                             two * shifted_a * by_aa - shifted_b * by_ab;
      float* out = derivatives_ + margin_ + x;
      by_mean.store(out);
      by_aa.store(out + padded_);
      by_ab.store(out + 2 * padded_);
    }
    if (p_.gradient) blur_derivatives(y);
    return total;
  }

  void blur_derivatives(int y) {
    for (int m = 0; m < 3; m++) {
      float* row = derivatives_ + m * padded_;
      std::fill(row + margin_ + length_, row + padded_, 0.f);
      for (int64_t x = 0; x < length_; x += LANES) blur_along(row + x).store(ring_row(m, y) + x);
    }
  }

  // Row y of the gradient and of sum |a - b|, once SSIM is known in the 11 rows around it.
  void finish(int y) {
    const float* rows[3][TAPS];
    for (int t = 0; t < TAPS; t++)
      for (int m = 0; m < 3; m++) {
        const int from = y + t - RADIUS;
        rows[m][t] = from >= 0 && from < p_.height ? ring_row(m, from) : zeros_;
      }
    const float count = float(p_.height) * float(length_);
    const Floats per_similarity = -p_.ssim_weight / count, per_difference = (1.f - p_.ssim_weight) / count, zero = 0.f;
    double total = 0;
    for (int64_t x = 0; x < length_; x += LANES) {
      const Floats a = load_row(p_.image + y * length_, x, length_), b = load_row(p_.target + y * length_, x, length_);
      const Floats difference = a - b;
      total += sum(abs(difference));
      if (!p_.gradient) continue;
      Floats by[3];
      for (int m = 0; m < 3; m++) by[m] = blur(p_.window, [&](int t) { return Floats::load(rows[m][t] + x); });
      const Floats on_similarity = by[0] + Floats(2.f) * (a - Floats(SHIFT)) * by[1] + (b - Floats(SHIFT)) * by[2];
      const Floats result = where(difference > zero, per_difference) - where(difference < zero, per_difference) +
                            per_similarity * on_similarity;
      float* out = p_.gradient + y * length_ + x;
      if (x + LANES <= length_) {
        result.store(out);
      } else {
        alignas(64) float lane[LANES];
        result.store(lane);
        std::memcpy(out, lane, sizeof(float) * (length_ - x));
      }
    }
    p_.differences[y] = total;
  }

  const Photometric& p_;
  const int begin_, end_;
  const int64_t length_, margin_, whole_, padded_;
  float *blurred_, *derivatives_, *ring_, *zeros_;
};

}  // namespace d2

using d2::Photometric;

extern "C" {

int64_t d2_photometric_size() { return sizeof(Photometric); }

// Fills in the gradient; returns the loss.
double d2_photometric(const Photometric* p) {
  const int bands = std::max(1, std::min(p->threads, p->height / 32));  // a band repeats ten rows of its neighbours
  d2::parallel_for(p->threads, bands, [&](int64_t band) {
    d2::Band(*p, int(p->height * band / bands), int(p->height * (band + 1) / bands)).run();
  });
  double difference = 0, similarity = 0;
  for (int y = 0; y < p->height; y++) difference += p->differences[y], similarity += p->similarities[y];
  const double count = double(p->height) * double(p->row_length()), weight = p->ssim_weight;
  return (1 - weight) * difference / count + weight * (1 - similarity / count);
}
}
