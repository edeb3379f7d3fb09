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

// A row of nodes, limited to 0..1 and interpolated at each pixel of the picture's width.
static void spread_row(const Behind& b, const float* raw, float* line) {
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
static void gather_row(const Behind& b, const float* line, float* nodes) {
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

// Lines of numbers, three a pixel, on which the loops below are flat: the compiler makes vectors of them.
static void repeat(const float* __restrict alpha, int width, float* __restrict rest) {
  for (int x = 0; x < width; x++) {
    const float value = 1 - alpha[x];
    rest[3 * x] = value, rest[3 * x + 1] = value, rest[3 * x + 2] = value;
  }
}

static void composite(const float* __restrict upper, const float* __restrict lower, float low,
                      const float* __restrict rest, const float* __restrict in, int64_t length, float* __restrict out) {
  for (int64_t i = 0; i < length; i++) out[i] = in[i] + rest[i] * (upper[i] + low * (lower[i] - upper[i]));
}

// What goes to the two rows of nodes, and the gradient times the background in `products`.
static void split(const float* __restrict upper, const float* __restrict lower, float low, const float* __restrict rest,
                  const float* __restrict gradient, int64_t length, float* __restrict to_upper,
                  float* __restrict to_lower, float* __restrict products) {
  for (int64_t i = 0; i < length; i++) {
    products[i] = gradient[i] * (upper[i] + low * (lower[i] - upper[i]));
    const float part = rest[i] * gradient[i], down = low * part;
    to_lower[i] += down;
    to_upper[i] += part - down;
  }
}

static void add_triples(const float* __restrict products, int width, float* __restrict on_alpha) {
  for (int x = 0; x < width; x++) on_alpha[x] = -(products[3 * x] + products[3 * x + 1] + products[3 * x + 2]);
}

// The pixels between two rows of nodes, whose colours are spread along them.
class Strip {
 public:
  Strip(const Behind& b, const std::vector<float>& raw, int row)
      : b_(b), begin_(row * b.stride), end_(std::min(b.height, (row + 1) * b.stride)), upper_(b.length()),
        lower_(b.length()), rest_(b.length()) {
    spread_row(b, raw.data() + int64_t(3) * b.columns * row, upper_.data());
    spread_row(b, raw.data() + int64_t(3) * b.columns * (row + 1), lower_.data());
  }

  void forward() {
    for (int y = begin_; y < end_; y++) {
      const int64_t at = y * b_.length();
      repeat(b_.alpha + int64_t(y) * b_.width, b_.width, rest_.data());
      composite(upper_.data(), lower_.data(), low(y), rest_.data(), b_.color + at, b_.length(), b_.out + at);
    }
  }

  // Writes the gradient of alpha; adds to both rows of nodes, [columns, 3] each.
  void backward(float* on_upper, float* on_lower) {
    std::vector<float> to_upper(b_.length(), 0.f), to_lower(b_.length(), 0.f), products(b_.length());
    for (int y = begin_; y < end_; y++) {
      repeat(b_.alpha + int64_t(y) * b_.width, b_.width, rest_.data());
      split(upper_.data(), lower_.data(), low(y), rest_.data(), b_.grad_out + y * b_.length(), b_.length(),
            to_upper.data(), to_lower.data(), products.data());
      add_triples(products.data(), b_.width, b_.grad_alpha + int64_t(y) * b_.width);
    }
    gather_row(b_, to_upper.data(), on_upper);
    gather_row(b_, to_lower.data(), on_lower);
  }

 private:
  // How far row y lies from the upper towards the lower nodes.
  float low(int y) const { return float(y - begin_) / float(b_.stride); }

  const Behind& b_;
  const int begin_, end_;
  std::vector<float> upper_, lower_, rest_;
};

// Gradients of the coefficients from those of the nodes, given for the upper and the lower row of each strip.
static void coefficient_gradients(const Behind& b, const std::vector<float>& raw, const std::vector<float>& strips) {
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
