// The photometric loss (1 - w) mean |a - b| + w (1 - mean SSIM(a, b)) and its gradient with respect to a, in one walk
// over the rows: what photometric.py does in torch.
//
// Images stay as they are, [H, W, C] with channels interleaved: a step of one pixel is a step of C numbers. LANES
// rows are worked on together, along the row unit by unit, where a unit is LANES pixels. Going down the columns a
// vector holds neighbours of one row; going along the row it holds the same number of LANES rows, so that either way a
// blur adds up whole vectors, each of them read once for LANES sums. A row of the gradient needs 11 rows of the
// derivatives of SSIM, which wait in a ring. Sums over a row are added up in the order of pixels, and those of rows in the order of
// rows, so results are the same bits for any number of threads.
#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "parallel.h"
#include "simd.h"

namespace d2 {

constexpr int RADIUS = 5, TAPS = 2 * RADIUS + 1;
constexpr int SPAN = TAPS - 1 + LANES;             // what LANES blurred values are made of
constexpr int LAG = (RADIUS + LANES - 1) / LANES;  // units that must lie beyond one that is blurred along the row
constexpr int HELD = 2 * LAG + 1;                  // units of blurred maps and of derivatives that are in use at a time
constexpr int RUN = 16;                            // vectors that are added up in float32, before float64
constexpr int AHEAD = 4 * LANES;                   // numbers of an image's row that are asked for before their turn
constexpr float C1 = 0.01f * 0.01f, C2 = 0.03f * 0.03f;

// Variances are differences of nearly equal numbers where an image is flat. They do not change if both images, and
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

// An image's row from number x on; zeros beyond its end.
D2_INLINE Floats load_row(const float* row, int64_t x, int64_t length) {
  if (x + LANES <= length) return Floats::load(row + x);
  alignas(64) float lane[LANES] = {};
  if (x < length) std::memcpy(lane, row + x, sizeof(float) * size_t(length - x));
  return Floats::load(lane);
}

// The same of bytes, over 255: the quotient is corrected by its remainder, which rounds it as a division does.
D2_INLINE Floats load_row(const uint8_t* row, int64_t x, int64_t length) {
  uint8_t lane[LANES] = {};
  const bool inside = x + LANES <= length;
  if (!inside && x < length) std::memcpy(lane, row + x, size_t(length - x));
  const Floats value = load_bytes(inside ? row + x : lane), part = value * Floats(1.f / 255.f);
#if defined(D2_AVX512) || defined(D2_AVX2)
  return fma(fnma(part, Floats(255.f), value), Floats(1.f / 255.f), part);
#else
  return value / Floats(255.f);  // without a fused multiply-add there is no exact remainder
#endif
}

// LANES neighbouring sums over 11 values weighted by the window, which is symmetric; value(t) is the t-th of SPAN.
// Where a multiplication and an addition round apart, both sides share a multiplication, and small weights come first.
template <class Value>
D2_INLINE void blur(const float* window, Value value, Floats (&out)[LANES]) {
  Floats weight[RADIUS + 1];
  for (int t = 0; t <= RADIUS; t++) weight[t] = window[t];
  if constexpr (LANES == 4) {
    for (int r = 0; r < LANES; r++) {
      out[r] = weight[0] * (value(r) + value(r + TAPS - 1));
      for (int t = 1; t < RADIUS; t++) out[r] = fma(weight[t], value(r + t) + value(r + TAPS - 1 - t), out[r]);
      out[r] = fma(weight[RADIUS], value(r + RADIUS), out[r]);
    }
    return;
  }
#pragma GCC unroll 32
  for (int t = SPAN - 1; t >= 0; t--) {
    const Floats next = value(t);
#pragma GCC unroll 16
    for (int r = 0; r < LANES; r++) {
      const int tap = t - r;
      if (tap == TAPS - 1) out[r] = weight[0] * next;
      if (tap >= 0 && tap < TAPS - 1) out[r] = fma(weight[tap <= RADIUS ? tap : TAPS - 1 - tap], next, out[r]);
    }
  }
}

// Rows begin..end-1 of the gradient, with the buffers for them.
class Band {
 public:
  Band(const Photometric& p, int begin, int end)
      : p_(p), begin_(begin), end_(end), channels_(p.channels), length_(p.row_length()),
        units_((p.width + LANES - 1) / LANES), unit_(int64_t(LANES) * p.channels),
        per_similarity_(-p.ssim_weight / (float(p.height) * float(length_))),
        per_difference_((1.f - p.ssim_weight) / (float(p.height) * float(length_))) {
    static thread_local std::vector<float> memory;
    const int64_t map = LANES * unit_;
    memory.resize(size_t((7 * HELD + 1) * map + 3 * SPAN * units_ * unit_ + 16));
    blurred_ = memory.data() + (64 - reinterpret_cast<uintptr_t>(memory.data()) % 64) % 64 / sizeof(float);
    derivatives_ = blurred_ + 4 * HELD * map;
    woven_ = derivatives_ + 3 * HELD * map;
    ring_ = woven_ + map;
  }

  void run() {
    const int reach = p_.gradient ? RADIUS : 0, last = std::min(p_.height, end_ + reach);
    int next = begin_;
    for (int y = std::max(0, begin_ - reach); y < last; y += LANES) {
      const int ready = std::min(y + LANES, last), finished = ready == last ? end_ : std::min(end_, ready - reach);
      walk(y, ready - y);
      for (int count; next < finished; next += count) finish(next, count = std::min(LANES, finished - next));
    }
  }

 private:
  bool is_row(int y) const { return y >= 0 && y < p_.height; }
  D2_INLINE Floats target(int y, int64_t x) const {
    return p_.bytes ? load_row(p_.bytes + y * length_, x, length_) : load_row(p_.target + y * length_, x, length_);
  }
  // LANES numbers of row y, from the x-th on, of a map in the ring.
  float* waiting(int map, int y, int64_t x) const {
    return ring_ + (x * 3 + int64_t(map) * LANES) * SPAN + y % SPAN * LANES;
  }
  // Number `channel` of a pixel in LANES rows, of a map of which HELD units are kept; pixels count from the margin on.
  float* held(float* maps, int map, int64_t pixel, int channel) const {
    return maps + LANES * ((map * HELD + pixel / LANES % HELD) * unit_ + pixel % LANES * channels_ + channel);
  }
  // Blurs a map along the row: LANES pixels of a unit.
  D2_INLINE void blur_along(float* maps, int map, int64_t unit, int channel, Floats (&out)[LANES]) const {
    const float* from[HELD];
    for (int i = 0; i < HELD; i++) from[i] = held(maps, map, (unit + i) * LANES, channel);
    const int64_t step = int64_t(LANES) * channels_;
    blur(p_.window, [&](int t) D2_FLAT { return Floats::load(from[t / LANES] + t % LANES * step); }, out);
  }
  // What lies outside of the image, from pixel first to last - 1 of maps that are blurred down the columns.
  void fill(float* maps, int count, const float* outside, int64_t first, int64_t last) const {
    for (int m = 0; m < count; m++)
      for (int64_t pixel = first; pixel < last; pixel++) std::fill_n(held(maps, m, pixel, 0), unit_, outside[m]);
  }

  // SSIM of rows y..y+count-1, and its derivatives blurred along the row, which go to the ring. What is beyond on the
  // right is needed first.
  void walk(int y, int count) {
    static constexpr float around[] = {-SHIFT, -SHIFT, 2 * SHIFT * SHIFT, SHIFT * SHIFT}, nothing[3] = {};
    fill(blurred_, 4, around, 0, RADIUS);
    fill(derivatives_, 3, nothing, 0, RADIUS);
    double totals[LANES] = {};
    for (int64_t unit = 0; unit < units_ + 2 * LAG; unit++) {
      const int64_t first = RADIUS + unit * LANES;
      if (unit < units_) blur_columns(y, unit);
      fill(blurred_, 4, around, std::max(first, RADIUS + int64_t(p_.width)), first + LANES);
      if (unit >= LAG && unit - LAG < units_)
        for (int channel = 0; channel < channels_; channel++) {
          float similarities[LANES];
          compare(unit - LAG, channel).store(similarities);
          for (int r = 0; r < LANES; r++) totals[r] += double(similarities[r]);
        }
      else if (unit >= LAG)
        fill(derivatives_, 3, nothing, first - LAG * LANES, first - LAG * LANES + LANES);
      if (p_.gradient && unit >= 2 * LAG) blur_derivatives(y, count, unit - 2 * LAG);
    }
    for (int r = 0; r < count; r++)
      if (y + r >= begin_ && y + r < end_) p_.similarities[y + r] = totals[r];
  }

  // Blurs a, b, a a + b b and a b down the columns around the rows y..y+LANES-1.
  void blur_columns(int y, int64_t unit) {
    for (int part = 0; part < channels_; part++) {
      const int64_t x = unit * unit_ + LANES * part;
      Floats values[4][SPAN];
      for (int t = 0; t < SPAN; t++) {
        const int row = y + t - RADIUS;
        Floats one = -SHIFT, other = -SHIFT;
        if (is_row(row)) {
          one = one + load_row(p_.image + row * length_, x, length_), other = other + target(row, x);
          __builtin_prefetch(p_.image + row * length_ + x + AHEAD);
          __builtin_prefetch(p_.bytes ? static_cast<const void*>(p_.bytes + row * length_ + x + AHEAD)
                                      : static_cast<const void*>(p_.target + row * length_ + x + AHEAD));
        }
        values[0][t] = one, values[1][t] = other;
        values[2][t] = fma(one, one, other * other), values[3][t] = one * other;
      }
      for (int m = 0; m < 4; m++) {
        Floats block[LANES];
        blur(p_.window, [&](int t) D2_FLAT { return values[m][t]; }, block);
        transpose(block);
        put_along(blurred_, m, unit, part, block);
      }
    }
  }

  // LANES vectors of numbers that follow each other along the row, part `part` of a unit's.
  D2_INLINE void put_along(float* maps, int map, int64_t unit, int part, const Floats (&block)[LANES]) const {
    const int64_t first = LANES * part + RADIUS * channels_;
    int64_t whole = unit + first / unit_, number = first % unit_;
#pragma GCC unroll 16
    for (int i = 0; i < LANES; i++) {
      block[i].store(maps + LANES * ((map * HELD + whole % HELD) * unit_ + number));
      if (++number == unit_) number = 0, whole++;
    }
  }

  // The sum of SSIM over a unit, row by row, and its derivatives by mean_a, a a and a b. Only the sum of both variances
  // counts, so a a and b b are blurred as one.
  Floats compare(int64_t unit, int channel) {
    const Floats two = 2.f, c1 = C1, c2 = C2;
    Floats maps[4][LANES], total = 0.f;
    for (int m = 0; m < 4; m++)
      blur_along(blurred_, m, unit, channel, maps[m]);
    float* places[3][LAG + 1];
    for (int m = 0; m < 3; m++)
      for (int k = 0; k <= LAG; k++) places[m][k] = held(derivatives_, m, (unit + k) * LANES, channel);
    const int64_t step = int64_t(LANES) * channels_;
    for (int i = 0; i < LANES; i++) {
      float* out[3];
      for (int m = 0; m < 3; m++) out[m] = places[m][(RADIUS + i) / LANES] + (RADIUS + i) % LANES * step;
      if (unit * LANES + i >= p_.width) {
        for (float* to : out) Floats(0.f).store(to);
        continue;
      }
      const Floats shifted_a = maps[0][i], shifted_b = maps[1][i];
      const Floats mean_a = shifted_a + Floats(SHIFT), mean_b = shifted_b + Floats(SHIFT);
      const Floats variances = maps[2][i] - (shifted_a * shifted_a + shifted_b * shifted_b);
      const Floats means_match = two * mean_a * mean_b + c1, means_size = mean_a * mean_a + mean_b * mean_b + c1;
      const Floats match = two * (maps[3][i] - shifted_a * shifted_b) + c2, size = variances + c2;
      const Floats inverse = Floats(1.f) / (means_size * size);
      const Floats similarity = means_match * match * inverse;
      total = total + similarity;
      const Floats by_aa = -similarity * (means_size * inverse), by_ab = two * means_match * inverse;
      const Floats by_mean = two * (mean_b * match * inverse - mean_a * similarity * (size * inverse)) -
                             two * shifted_a * by_aa - shifted_b * by_ab;
      by_mean.store(out[0]);
      by_aa.store(out[1]);
      by_ab.store(out[2]);
    }
    return total;
  }

  void blur_derivatives(int y, int count, int64_t unit) {
    for (int m = 0; m < 3; m++) {
      Floats block[LANES];
      for (int channel = 0; channel < channels_; channel++) {
        blur_along(derivatives_, m, unit, channel, block);
#pragma GCC unroll 16
        for (int i = 0; i < LANES; i++) block[i].store(woven_ + LANES * (i * channels_ + channel));
      }
      for (int part = 0; part < channels_; part++) {
#pragma GCC unroll 16
        for (int i = 0; i < LANES; i++) block[i] = Floats::load(woven_ + LANES * (LANES * part + i));
        transpose(block);
        const int64_t x = unit * unit_ + LANES * part;
#pragma GCC unroll 16
        for (int r = 0; r < LANES; r++)
          if (r < count) block[r].store(waiting(m, y + r, x));
      }
    }
  }

  // Rows y..y+count-1 of the gradient and of sum |a - b|, once SSIM is known in the rows around them.
  void finish(int y, int count) {
    alignas(64) static constexpr float nothing[LANES] = {};
    int64_t places[SPAN];
    for (int t = 0; t < SPAN; t++) places[t] = is_row(y + t - RADIUS) ? (y + t - RADIUS) % SPAN * LANES : -1;
    double totals[LANES] = {};
    Floats runs[LANES];
    for (int64_t x = 0, run = 0; x < length_; x += LANES) {
      Floats by[3][LANES];
      for (int m = 0; m < (p_.gradient ? 3 : 0); m++) {
        const float* const from = waiting(m, 0, x);
        blur(p_.window, [&](int t) D2_FLAT { return Floats::load(places[t] < 0 ? nothing : from + places[t]); }, by[m]);
      }
      for (int r = 0; r < count; r++) {
        const Floats difference = finish_numbers(y + r, x, by[0][r], by[1][r], by[2][r]);
        runs[r] = run ? runs[r] + difference : difference;
      }
      if (++run < RUN && x + LANES < length_) continue;
      for (int r = 0; r < count; r++) totals[r] += double(sum(runs[r]));
      run = 0;
    }
    std::copy_n(totals, count, p_.differences + y);
  }

  // The gradient at LANES numbers of row y, from the blurred derivatives; returns |a - b|.
  D2_INLINE Floats finish_numbers(int y, int64_t x, Floats by_mean, Floats by_aa, Floats by_ab) const {
    const Floats per_similarity = per_similarity_, per_difference = per_difference_, zero = 0.f;
    const Floats a = load_row(p_.image + y * length_, x, length_), b = target(y, x);
    const Floats difference = a - b;
    if (!p_.gradient) return abs(difference);
    const Floats on_similarity = by_mean + Floats(2.f) * (a - Floats(SHIFT)) * by_aa + (b - Floats(SHIFT)) * by_ab;
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
  const int begin_, end_, channels_;
  const int64_t length_, units_, unit_;
  const float per_similarity_, per_difference_;
  float *blurred_, *derivatives_, *woven_, *ring_;
};

}  // namespace d2

using d2::Photometric;

extern "C" {

int64_t d2_ssim_size() { return sizeof(Photometric); }

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
