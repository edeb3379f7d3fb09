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
constexpr int ROWS = LANES == 16 ? 4 : 2;  // blurred together: a row is then loaded once for all of them
constexpr int SPAN = TAPS - 1 + ROWS, RING = TAPS - 1 + 2 * ROWS;
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
  const uint8_t* bytes;                // [H, W, C], the target times 255; null where it is given as numbers
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

// The sum of numbers in double, lane by lane.
class Total {
 public:
  D2_INLINE void add(Floats values, int64_t count) {
    if (count < LANES) {
      alignas(64) float lane[LANES];
      values.store(lane);
      std::fill(lane + count, lane + LANES, 0.f);
      values = Floats::load(lane);
    }
    lanes_ += __builtin_convertvector(values.v, Doubles);
  }
  double sum() const {
    double total = 0;
    for (int i = 0; i < LANES; i++) total += lanes_[i];
    return total;
  }

 private:
  typedef double Doubles __attribute__((vector_size(8 * LANES)));
  Doubles lanes_ = {};
};

// Rows begin..end-1 of the gradient, with the buffers for them.
class Band {
 public:
  Band(const Photometric& p, int begin, int end)
      : p_(p), begin_(begin), end_(end), first_(std::max(0, begin - 2 * RADIUS)), length_(p.row_length()),
        margin_(int64_t(RADIUS) * p.channels), whole_((length_ + LANES - 1) / LANES * LANES),
        padded_(whole_ + 2 * margin_) {
    static thread_local std::vector<float> memory, target;
    memory.assign(size_t((4 * ROWS + 3) * padded_ + (3 * RING + 1) * whole_), 0.f);
    blurred_ = memory.data();
    derivatives_ = blurred_ + 4 * ROWS * padded_;
    ring_ = derivatives_ + 3 * padded_;
    zeros_ = ring_ + 3 * RING * whole_;
    const float outside[] = {-SHIFT, -SHIFT, 2 * SHIFT * SHIFT, SHIFT * SHIFT};
    for (int m = 0; m < 4 * ROWS; m++) std::fill_n(blurred_ + m * padded_, padded_, outside[m % 4]);
    target_ = p.target;
    if (p.bytes) target_ = numbers(target) - first_ * length_;
  }

  void run() {
    const int reach = p_.gradient ? RADIUS : 0, last = std::min(p_.height, end_ + reach);
    int next = begin_;
    for (int y = std::max(0, begin_ - reach); y < last; y += ROWS) {
      const int ready = std::min(y + ROWS, last);
      blur_columns(y);
      for (int row = y; row < ready; row++) {
        const double similarity = compare(row, blurred_ + 4 * (row - y) * padded_);
        if (row >= begin_ && row < end_) p_.similarities[row] = similarity;
      }
      for (int count; next < end_; next += count) {
        count = std::min(ROWS, end_ - next);
        if (std::min(next + count - 1 + reach, p_.height - 1) >= ready) break;
        finish(next, count);
      }
    }
  }

 private:
  // The target's rows that this band looks at, as numbers. Rows are blurred ROWS together, so it looks at up to
  // ROWS - 1 more than it needs.
  const float* numbers(std::vector<float>& memory) const {
    const int64_t last = std::min(p_.height, end_ + 2 * RADIUS + ROWS - 1), count = (last - first_) * length_;
    memory.resize(size_t(count));
    const uint8_t* from = p_.bytes + first_ * length_;
    float* to = memory.data();
    for (int64_t i = 0; i < count; i++) to[i] = float(from[i]) / 255.f;
    return to;
  }

  const float* row_of(const float* picture, int y) const {
    return y >= 0 && y < p_.height ? picture + y * length_ : zeros_;
  }
  float* ring_row(int map, int y) const { return ring_ + (map * RING + y % RING) * whole_; }

  // Along a padded row, from the pixel five to the left.
  Floats blur_along(const float* from) const {
    return blur(p_.window, [&](int t) { return Floats::load(from + int64_t(t) * p_.channels); });
  }

  // Blurs a, b, a a + b b and a b down the columns around the rows y..y+ROWS-1.
  void blur_columns(int y) {
    const float *a[SPAN], *b[SPAN];
    for (int t = 0; t < SPAN; t++) a[t] = row_of(p_.image, y + t - RADIUS), b[t] = row_of(target_, y + t - RADIUS);
    for (int64_t x = 0; x < length_; x += LANES) {
      Floats sums[ROWS][4];
      for (int r = 0; r < ROWS; r++)
        for (int m = 0; m < 4; m++) sums[r][m] = 0.f;
#pragma GCC unroll 16
      for (int t = 0; t < SPAN; t++) {
        const Floats one = load_row(a[t], x, length_) - Floats(SHIFT), other = load_row(b[t], x, length_) - Floats(SHIFT);
        const Floats values[] = {one, other, fma(one, one, other * other), one * other};
#pragma GCC unroll 4
        for (int r = 0; r < ROWS; r++)
          if (t - r >= 0 && t - r < TAPS)
#pragma GCC unroll 4
            for (int m = 0; m < 4; m++) sums[r][m] = fma(Floats(p_.window[t - r]), values[m], sums[r][m]);
      }
      for (int r = 0; r < ROWS; r++)
        for (int m = 0; m < 4; m++) sums[r][m].store(blurred_ + (4 * r + m) * padded_ + margin_ + x);
    }
  }

  // Sum of SSIM over row y, blurred down the columns; its derivatives by mean_a, a a and a b, blurred along the row, go
  // to the ring. Only the sum of both variances counts, so a a and b b are blurred as one.
  double compare(int y, const float* blurred) {
    Total total;
    for (int64_t x = 0; x < length_; x += LANES) {
      Floats maps[4];
      for (int m = 0; m < 4; m++) maps[m] = blur_along(blurred + m * padded_ + x);
      const Floats shifted_a = maps[0], shifted_b = maps[1], two = 2.f, c1 = C1, c2 = C2;
      const Floats mean_a = shifted_a + Floats(SHIFT), mean_b = shifted_b + Floats(SHIFT);
      const Floats variances = maps[2] - (shifted_a * shifted_a + shifted_b * shifted_b);
      const Floats means_match = two * mean_a * mean_b + c1, means_size = mean_a * mean_a + mean_b * mean_b + c1;
      const Floats match = two * (maps[3] - shifted_a * shifted_b) + c2, size = variances + c2;
      const Floats inverse = Floats(1.f) / (means_size * size);
      const Floats similarity = means_match * match * inverse;
      total.add(similarity, length_ - x);
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
    return total.sum();
  }

  void blur_derivatives(int y) {
    for (int m = 0; m < 3; m++) {
      float* row = derivatives_ + m * padded_;
      std::fill(row + margin_ + length_, row + padded_, 0.f);
      for (int64_t x = 0; x < length_; x += LANES) blur_along(row + x).store(ring_row(m, y) + x);
    }
  }

  // Rows y..y+count-1 of the gradient and of sum |a - b|, once SSIM is known in the rows around them.
  void finish(int y, int count) {
    const float* rows[SPAN][3];
    for (int t = 0; t < SPAN; t++)
      for (int m = 0; m < 3; m++) {
        const int from = y + t - RADIUS;
        rows[t][m] = from >= 0 && from < p_.height ? ring_row(m, from) : zeros_;
      }
    Total totals[ROWS];
    for (int64_t x = 0; x < length_; x += LANES) {
      Floats by[ROWS][3];
      if (p_.gradient) blur_finally(rows, x, by);
      for (int r = 0; r < count; r++) totals[r].add(finish_numbers(y + r, x, by[r]), length_ - x);
    }
    for (int r = 0; r < count; r++) p_.differences[y + r] = totals[r].sum();
  }

  void blur_finally(const float* const (&rows)[SPAN][3], int64_t x, Floats (&by)[ROWS][3]) const {
    for (int r = 0; r < ROWS; r++)
      for (int m = 0; m < 3; m++) by[r][m] = 0.f;
#pragma GCC unroll 16
    for (int t = 0; t < SPAN; t++)
#pragma GCC unroll 4
      for (int m = 0; m < 3; m++) {
        const Floats value = Floats::load(rows[t][m] + x);
#pragma GCC unroll 4
        for (int r = 0; r < ROWS; r++)
          if (t - r >= 0 && t - r < TAPS) by[r][m] = fma(Floats(p_.window[t - r]), value, by[r][m]);
      }
  }

  // The gradient at LANES numbers of row y, from the blurred derivatives; returns |a - b|.
  D2_INLINE Floats finish_numbers(int y, int64_t x, const Floats (&by)[3]) const {
    const float number = float(p_.height) * float(length_);
    const Floats per_similarity = -p_.ssim_weight / number, per_difference = (1.f - p_.ssim_weight) / number, zero = 0.f;
    const Floats a = load_row(p_.image + y * length_, x, length_), b = load_row(target_ + y * length_, x, length_);
    const Floats difference = a - b;
    if (!p_.gradient) return abs(difference);
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
    return abs(difference);
  }

  const Photometric& p_;
  const int begin_, end_;
  const int64_t first_, length_, margin_, whole_, padded_;
  const float* target_;
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
