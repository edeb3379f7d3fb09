// The background behind all Gaussians, forward and backward.
// Sums are taken in an order that does not depend on the number of threads.
#include <algorithm>
#include <cstdint>
#include <vector>

#include "parallel.h"
#include "simd.h"

namespace d2 {

constexpr int SEGMENT = 64;           // pixels of a row whose sums stay near while the rows of a strip go by

// The background of an image [height, width, 3], as native_background.py fills it in: colours at nodes that lie `stride`
// pixels apart, spherical harmonics times coefficients, bilinear in between.
struct Background {
  int32_t height, width, rows, columns, stride, terms, threads;
  const float *basis, *constant, *harmonics;             // [rows * columns, terms], [1, 3], [terms - 1, 3]
  const float *color, *alpha;                            // [height, width, 3], [height, width]
  float* out;                                            // [height, width, 3]
  const float* grad_out;                                 // as the gradients below null going forward
  float *grad_alpha, *grad_constant, *grad_harmonics;

  int64_t nodes() const { return int64_t(rows) * columns; }
  int64_t length() const { return int64_t(width) * 3; }
};

// Colours of the nodes before they are limited to 0..1.
static void node_colors(const Background& b, float* raw) {
  for (int64_t n = 0; n < b.nodes(); n++) {
    const float* y = b.basis + n * b.terms;
    for (int c = 0; c < 3; c++) {
      float value = y[0] * b.constant[c];
      for (int k = 1; k < b.terms; k++) value += y[k] * b.harmonics[3 * (k - 1) + c];
      raw[3 * n + c] = value + 0.5f;
    }
  }
}

// A row of nodes, limited to 0..1 and interpolated at each pixel of the image's width.
static void spread_row(const Background& b, const float* raw, float* line) {
  const float step = 1.f / float(b.stride);
  for (int column = 0, x = 0; x < b.width; column++) {
    float from[3], slope[3];
    for (int c = 0; c < 3; c++) {
      from[c] = std::min(std::max(raw[3 * column + c], 0.f), 1.f);
      slope[c] = std::min(std::max(raw[3 * column + 3 + c], 0.f), 1.f) - from[c];
    }
    for (int i = 0; i < b.stride && x < b.width; i++, x++)
      for (int c = 0; c < 3; c++) line[3 * x + c] = from[c] + float(i) * step * slope[c];
  }
}

// The transpose: what came to the pixels of a line, gathered at its nodes.
static void gather_row(const Background& b, const float* line, float* nodes) {
  const float step = 1.f / float(b.stride);
  for (int column = 0, x = 0; x < b.width; column++) {
    float all[3] = {0, 0, 0}, right[3] = {0, 0, 0};
    for (int i = 0; i < b.stride && x < b.width; i++, x++)
      for (int c = 0; c < 3; c++) {
        all[c] += line[3 * x + c];
        right[c] += float(i) * step * line[3 * x + c];
      }
    for (int c = 0; c < 3; c++) {
      nodes[3 * column + c] += all[c] - right[c];
      nodes[3 * column + 3 + c] += right[c];
    }
  }
}

// A number for each pixel, as it stands beside its three colours.
D2_INLINE void repeat(Floats values, Floats (&out)[3]) {
  const Floats all[3] = {values, values, values};
  weave<LANES, 3>(all, out);
}

// One row of a strip: what the Gaussians leave of each ray shows what lies `low` of the way from `upper` to `lower`.
static void composite(const float* upper, const float* lower, float low, const float* alpha, const float* in, int width,
                      float* out) {
  int x = 0;
  for (; x + LANES <= width; x += LANES) {
    Floats rest[3];
    repeat(Floats(1.f) - Floats::load(alpha + x), rest);
    for (int n = 0; n < 3; n++) {
      const int64_t i = int64_t(3) * x + n * LANES;
      const Floats above = Floats::load(upper + i), behind = fma(low, Floats::load(lower + i) - above, above);
      fma(rest[n], behind, Floats::load(in + i)).store(out + i);
    }
  }
  for (int64_t i = int64_t(3) * x; i < int64_t(3) * width; i++)
    out[i] = in[i] + (1 - alpha[i / 3]) * (upper[i] + low * (lower[i] - upper[i]));
}

// The transpose, pixels begin..end-1 of the row: adds what goes to both rows of nodes, and gives the gradient of alpha.
static void split(const float* upper, const float* lower, float low, const float* alpha, const float* gradient,
                  int begin, int end, float* to_upper, float* to_lower, float* on_alpha) {
  int x = begin;
  for (; x + LANES <= end; x += LANES) {
    Floats rest[3], products[3], colors[3];
    repeat(Floats(1.f) - Floats::load(alpha + x), rest);
    for (int n = 0; n < 3; n++) {
      const int64_t i = int64_t(3) * x + n * LANES;
      const Floats above = Floats::load(upper + i), given = Floats::load(gradient + i), part = rest[n] * given;
      products[n] = given * fma(low, Floats::load(lower + i) - above, above);
      const Floats down = Floats(low) * part;
      (Floats::load(to_lower + i) + down).store(to_lower + i);
      (Floats::load(to_upper + i) + (part - down)).store(to_upper + i);
    }
    unweave<LANES, 3>(products, colors);
    const Floats through = colors[0] + colors[1] + colors[2];
    (-through).store(on_alpha + x);
  }
  for (; x < end; x++) {
    float product = 0;
    for (int64_t i = int64_t(3) * x; i < int64_t(3) * (x + 1); i++) {
      product += gradient[i] * (upper[i] + low * (lower[i] - upper[i]));
      const float part = (1 - alpha[x]) * gradient[i], down = low * part;
      to_lower[i] += down;
      to_upper[i] += part - down;
    }
    on_alpha[x] = -product;
  }
}

// The pixels between two rows of nodes, whose colours are spread along them.
class Strip {
 public:
  Strip(const Background& b, const std::vector<float>& raw, int row)
      : b_(b), begin_(row * b.stride), end_(std::min(b.height, (row + 1) * b.stride)), upper_(b.length()),
        lower_(b.length()) {
    spread_row(b, raw.data() + int64_t(3) * b.columns * row, upper_.data());
    spread_row(b, raw.data() + int64_t(3) * b.columns * (row + 1), lower_.data());
  }

  void forward() {
    for (int y = begin_; y < end_; y++) {
      const int64_t at = y * b_.length();
      composite(upper_.data(), lower_.data(), low(y), b_.alpha + int64_t(y) * b_.width, b_.color + at, b_.width,
                b_.out + at);
    }
  }

  // Writes the gradient of alpha; adds to both rows of nodes, [columns, 3] each.
  void backward(float* on_upper, float* on_lower) {
    std::vector<float> to_upper(b_.length(), 0.f), to_lower(b_.length(), 0.f);
    for (int begin = 0; begin < b_.width; begin += SEGMENT)
      for (int y = begin_; y < end_; y++) {
        const int64_t at = int64_t(y) * b_.width;
        split(upper_.data(), lower_.data(), low(y), b_.alpha + at, b_.grad_out + 3 * at, begin,
              std::min(b_.width, begin + SEGMENT), to_upper.data(), to_lower.data(), b_.grad_alpha + at);
      }
    gather_row(b_, to_upper.data(), on_upper);
    gather_row(b_, to_lower.data(), on_lower);
  }

 private:
  // How far row y lies from the upper towards the lower nodes.
  float low(int y) const { return float(y - begin_) / float(b_.stride); }

  const Background& b_;
  const int begin_, end_;
  std::vector<float> upper_, lower_;
};

// Gradients of the coefficients from those of the nodes, given for the upper and the lower row of each strip.
static void coefficient_gradients(const Background& b, const std::vector<float>& raw, const std::vector<float>& strips) {
  std::vector<double> sums(size_t(3) * b.terms, 0.0);
  const int64_t row_length = int64_t(3) * b.columns;
  for (int64_t node = 0; node < b.nodes(); node++) {
    const int64_t row = node / b.columns, at = 3 * (node % b.columns);
    const float* y = b.basis + node * b.terms;
    for (int c = 0; c < 3; c++) {
      const float value = raw[3 * node + c];
      if (!(value >= 0 && value <= 1)) continue;  // limited: no gradient
      float g = 0;
      if (row < b.rows - 1) g += strips[2 * row * row_length + at + c];
      if (row > 0) g += strips[(2 * row - 1) * row_length + at + c];
      double* __restrict to = sums.data() + int64_t(c) * b.terms;
      for (int k = 0; k < b.terms; k++) to[k] += double(y[k]) * double(g);
    }
  }
  for (int c = 0; c < 3; c++) {
    b.grad_constant[c] = float(sums[int64_t(c) * b.terms]);
    for (int k = 1; k < b.terms; k++) b.grad_harmonics[3 * (k - 1) + c] = float(sums[int64_t(c) * b.terms + k]);
  }
}

}  // namespace d2

using d2::Background;

extern "C" {

int64_t d2_background_size() { return sizeof(Background); }

void d2_background(const Background* b) {
  std::vector<float> raw(size_t(3) * b->nodes());
  d2::node_colors(*b, raw.data());
  d2::parallel_for(b->threads, b->rows - 1, [&](int64_t row) { d2::Strip(*b, raw, int(row)).forward(); });
}

void d2_background_backward(const Background* b) {
  const int64_t row_length = int64_t(3) * b->columns;
  std::vector<float> raw(size_t(3) * b->nodes()), strips(size_t(2) * (b->rows - 1) * row_length, 0.f);
  d2::node_colors(*b, raw.data());
  d2::parallel_for(b->threads, b->rows - 1, [&](int64_t row) {
    float* on = strips.data() + 2 * row * row_length;
    d2::Strip(*b, raw, int(row)).backward(on, on + row_length);
  });
  d2::coefficient_gradients(*b, raw, strips);
}
}
