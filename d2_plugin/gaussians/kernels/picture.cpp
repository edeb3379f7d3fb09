// What lies between Gaussians and picture beside the rasterizer, forward and backward: colours that do not depend on the
// direction, the background behind all Gaussians, and the screen-space gradients that density control adds up.
// Sums are taken in an order that does not depend on the number of threads.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "parallel.h"

namespace d2 {

constexpr int64_t ROWS_CHUNK = 4096;  // Gaussians of one task
constexpr float SH_C0 = 0.28209479177387814f;

template <class Body>
static void for_each_chunk(int threads, int64_t count, Body body) {
  parallel_for(threads, (count + ROWS_CHUNK - 1) / ROWS_CHUNK, [&](int64_t chunk) {
    body(chunk * ROWS_CHUNK, std::min(count, (chunk + 1) * ROWS_CHUNK));
  });
}

// The background of a picture [height, width, 3], as native_background.py fills it in: colours at nodes that lie `stride`
// pixels apart, spherical harmonics times coefficients, bilinear in between.
struct Behind {
  int32_t height, width, rows, columns, stride, terms, threads;
  const float *basis, *constant, *harmonics;             // [rows * columns, terms], [1, 3], [terms - 1, 3]
  const float *color, *alpha;                            // [height, width, 3], [height, width]
  float* out;                                            // [height, width, 3]
  const float* grad_out;                                 // null going forward
  float *grad_alpha, *grad_constant, *grad_harmonics;

  int64_t nodes() const { return int64_t(rows) * columns; }
  int64_t length() const { return int64_t(width) * 3; }
};

// Colours of the nodes before they are limited to 0..1.
static void node_colors(const Behind& b, float* raw) {
  for (int64_t n = 0; n < b.nodes(); n++) {
    const float* y = b.basis + n * b.terms;
    for (int c = 0; c < 3; c++) {
      float value = y[0] * b.constant[c];
      for (int k = 1; k < b.terms; k++) value += y[k] * b.harmonics[3 * (k - 1) + c];
      raw[3 * n + c] = value + 0.5f;
    }
  }
}

static float limited(float value) { return std::min(std::max(value, 0.f), 1.f); }

// A row of nodes, interpolated at each pixel of the picture's width.
static void spread_row(const Behind& b, const float* raw, float* line) {
  const float step = 1.f / float(b.stride);
  for (int column = 0, x = 0; x < b.width; column++) {
    const float* left = raw + 3 * column;
    for (int i = 0; i < b.stride && x < b.width; i++, x++)
      for (int c = 0; c < 3; c++) {
        const float from = limited(left[c]), to = i ? limited(left[3 + c]) : from;
        line[3 * x + c] = from + float(i) * step * (to - from);
      }
  }
}

// The transpose: what came to the pixels of a line, gathered at its nodes.
static void gather_row(const Behind& b, const float* line, float* nodes) {
  const float step = 1.f / float(b.stride);
  for (int column = 0, x = 0; x < b.width; column++)
    for (int i = 0; i < b.stride && x < b.width; i++, x++)
      for (int c = 0; c < 3; c++) {
        const float right = float(i) * step * line[3 * x + c];
        nodes[3 * column + c] += line[3 * x + c] - right;
        if (i) nodes[3 * column + 3 + c] += right;
      }
}

// The pixels between two rows of nodes: [rows of pixels], with the nodes' colours spread along them.
class Strip {
 public:
  Strip(const Behind& b, const std::vector<float>& raw, int row)
      : b_(b), row_(row), begin_(row * b.stride), end_(std::min(b.height, (row + 1) * b.stride)),
        upper_(b.length()), lower_(b.length()), colors_(b.length()) {
    spread_row(b, raw.data() + int64_t(3) * b.columns * row, upper_.data());
    spread_row(b, raw.data() + int64_t(3) * b.columns * (row + 1), lower_.data());
  }

  void forward() {
    for (int y = begin_; y < end_; y++) {
      const float* colors = row_colors(y);
      const float *alpha = b_.alpha + int64_t(y) * b_.width, *in = b_.color + y * b_.length();
      float* out = b_.out + y * b_.length();
      for (int x = 0; x < b_.width; x++) {
        const float rest = 1 - alpha[x];
        for (int c = 0; c < 3; c++) out[3 * x + c] = in[3 * x + c] + rest * colors[3 * x + c];
      }
    }
  }

  // Writes the gradient of alpha; adds to both rows of nodes, [columns, 3] each.
  void backward(float* on_upper, float* on_lower) {
    std::vector<float> to_upper(b_.length(), 0.f), to_lower(b_.length(), 0.f);
    for (int y = begin_; y < end_; y++) {
      const float* colors = row_colors(y);
      const float *alpha = b_.alpha + int64_t(y) * b_.width, *grad = b_.grad_out + y * b_.length();
      float* on_alpha = b_.grad_alpha + int64_t(y) * b_.width;
      const float low = float(y - begin_) / float(b_.stride), high = 1 - low;
      for (int x = 0; x < b_.width; x++) {
        const float* g = grad + 3 * x;
        const float* color = colors + 3 * x;
        on_alpha[x] = -(g[0] * color[0] + g[1] * color[1] + g[2] * color[2]);
        const float rest = 1 - alpha[x];
        for (int c = 0; c < 3; c++) {
          const float part = rest * g[c];
          to_upper[3 * x + c] += high * part;
          to_lower[3 * x + c] += low * part;
        }
      }
    }
    gather_row(b_, to_upper.data(), on_upper);
    gather_row(b_, to_lower.data(), on_lower);
  }

 private:
  const float* row_colors(int y) {
    const float low = float(y - begin_) / float(b_.stride);
    for (int64_t i = 0; i < b_.length(); i++) colors_[i] = upper_[i] + low * (lower_[i] - upper_[i]);
    return colors_.data();
  }

  const Behind& b_;
  const int row_, begin_, end_;
  std::vector<float> upper_, lower_, colors_;
};

// Gradients of the coefficients from those of the nodes, given for the upper and the lower row of each strip.
static void coefficient_gradients(const Behind& b, const std::vector<float>& raw, const std::vector<float>& strips) {
  std::vector<double> sums(size_t(3) * b.terms, 0.0);
  const int64_t row_length = int64_t(3) * b.columns;
  for (int row = 0; row < b.rows; row++)
    for (int64_t i = 0; i < row_length; i++) {
      const float value = raw[row * row_length + i];
      if (!(value >= 0 && value <= 1)) continue;  // limited: no gradient
      float g = 0;
      if (row < b.rows - 1) g += strips[2 * row * row_length + i];
      if (row > 0) g += strips[(2 * row - 1) * row_length + i];
      const float* y = b.basis + (int64_t(row) * b.columns + i / 3) * b.terms;
      for (int k = 0; k < b.terms; k++) sums[3 * k + i % 3] += double(y[k] * g);
    }
  for (int c = 0; c < 3; c++) b.grad_constant[c] = float(sums[c]);
  for (int i = 3; i < 3 * b.terms; i++) b.grad_harmonics[i - 3] = float(sums[i]);
}

}  // namespace d2

using d2::Behind;

extern "C" {

// colors[m] = max(0, C0 base[rows[m]] + 1/2), three numbers each; rows may be null for all of them.
void d2_colors(const float* base, const int64_t* rows, int64_t drawn, float* colors, int32_t threads) {
  d2::for_each_chunk(threads, drawn, [&](int64_t begin, int64_t end) {
    for (int64_t m = begin; m < end; m++) {
      const float* from = base + 3 * (rows ? rows[m] : m);
      for (int c = 0; c < 3; c++) colors[3 * m + c] = std::max(d2::SH_C0 * from[c] + 0.5f, 0.f);
    }
  });
}

// The gradient of base [count, 3]: zero for rows that are not drawn, and where a colour is 0. Rows only ever increase.
void d2_colors_backward(const float* colors, const float* gradient, const int64_t* rows, int64_t drawn, int64_t count,
                        float* grad_base, int32_t threads) {
  if (drawn == 0) std::fill(grad_base, grad_base + 3 * count, 0.f);
  d2::for_each_chunk(threads, drawn, [&](int64_t begin, int64_t end) {
    if (rows && drawn < count) {
      float* const from = grad_base + 3 * (begin ? rows[begin] : 0);
      std::fill(from, grad_base + 3 * (end < drawn ? rows[end] : count), 0.f);
    }
    for (int64_t m = begin; m < end; m++) {
      float* to = grad_base + 3 * (rows ? rows[m] : m);
      for (int c = 0; c < 3; c++) to[c] = colors[3 * m + c] > 0 ? d2::SH_C0 * gradient[3 * m + c] : 0.f;
    }
  });
}

// Adds the length of each screen-space gradient [drawn, 2], in units of half the picture, to the sums of its Gaussian.
void d2_screen(const float* gradient, const int64_t* rows, int64_t drawn, float half_width, float half_height,
               float* sums, float* seen, int32_t threads) {
  d2::for_each_chunk(threads, drawn, [&](int64_t begin, int64_t end) {
    for (int64_t m = begin; m < end; m++) {
      const float x = gradient[2 * m] * half_width, y = gradient[2 * m + 1] * half_height;
      const float length = std::sqrt(x * x + y * y);
      sums[rows[m]] += length;
      seen[rows[m]] += length > 0 ? 1.f : 0.f;
    }
  });
}

int64_t d2_behind_size() { return sizeof(Behind); }

void d2_behind(const Behind* b) {
  std::vector<float> raw(size_t(3) * b->nodes());
  d2::node_colors(*b, raw.data());
  d2::parallel_for(b->threads, b->rows - 1, [&](int64_t row) { d2::Strip(*b, raw, int(row)).forward(); });
}

void d2_behind_backward(const Behind* b) {
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
