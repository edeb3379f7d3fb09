// The smooth field of the local correction (correct.py): block sums, then robust averages from coarse to fine.
//
// Additions and products are in the order of NumPy and of a matrix product that sums along k with fused multiply-adds,
// so that results are NumPy's own bits where its BLAS does the same; what lies outside of a window is a zero that is
// left out. One task per map: the same bits for any number of threads.
#include <cstdint>
#include <vector>

#include "lanes.h"
#include "parallel.h"

namespace d2 {

// Mirrored by `_Field` in field.py.
struct Field {
  int32_t width, height, cell, maps, scales, rounds, threads;
  float prior, outlier, outlier_squared;
  int64_t bend_stride;      // floats from one map to the next; 0 where they share one
  const float* bend;        // [maps, height, width], correction of log depth; read where it is known
  const uint8_t* known;     // [maps, height, width]
  const float* down;        // [scales, rows, rows], blur of a column of cells
  const float* across;      // [scales, columns, columns], blur of a row of cells
  const int32_t* reach;     // [scales], cells beyond which a window is zero
  float* field;             // [maps, rows, columns]
};

namespace {

constexpr int ROWS = 6;    // of a product at a time: with two vectors of columns, as registers allow

D2_FN int least(int a, int b) { return a < b ? a : b; }
D2_FN int most(int a, int b) { return a > b ? a : b; }

// Sum of n floats in NumPy's order (its pairwise sum of up to 128).
float sum_of(const float* from, int n) {
  if (n < 8) {
    float total = 0;
    for (int i = 0; i < n; i++) total += from[i];
    return total;
  }
  float part[8];
  for (int i = 0; i < 8; i++) part[i] = from[i];
  int done = 8;
  for (; done + 8 <= n; done += 8)
    for (int i = 0; i < 8; i++) part[i] += from[done + i];
  float total = ((part[0] + part[1]) + (part[2] + part[3])) + ((part[4] + part[5]) + (part[6] + part[7]));
  for (; done < n; done++) total += from[done];
  return total;
}

// out[r][V vectors at column] = sum over k in first..last-1 of left[r][k] right[k][V vectors at column], for R rows.
template <int R, int V>
D2_FN void product(const float* left, int left_stride, const float* right, int stride, int first, int last, float* out) {
  Floats total[R][V];
  for (int r = 0; r < R; r++)
    for (int v = 0; v < V; v++) total[r][v] = Floats{};
  for (int k = first; k < last; k++) {
    Floats there[V];
    for (int v = 0; v < V; v++) there[v] = load<Floats>(right + int64_t(k) * stride + v * kLanes);
    for (int r = 0; r < R; r++) {
      const Floats here = Floats{} + left[r * left_stride + k];
      for (int v = 0; v < V; v++) total[r][v] = mad(here, there[v], total[r][v]);
    }
  }
  for (int r = 0; r < R; r++)
    for (int v = 0; v < V; v++) store(out + r * stride + v * kLanes, total[r][v]);
}

// The same for any number of rows.
template <int V>
void products(const float* left, int left_stride, int rows, const float* right, int stride, int first, int last, float* out) {
  int row = 0;
  for (; row + ROWS <= rows; row += ROWS)
    product<ROWS, V>(left + int64_t(row) * left_stride, left_stride, right, stride, first, last, out + int64_t(row) * stride);
  for (; row < rows; row++)
    product<1, V>(left + int64_t(row) * left_stride, 0, right, stride, first, last, out + int64_t(row) * stride);
}

// Rows of cells, padded to whole vectors: the padding is zero and stays so.
struct Cells {
  int rows, columns, stride;
  int64_t size() const { return int64_t(rows) * stride; }
};

// Blur by one scale: the matrices of a call, their rows padded.
struct Blur {
  std::vector<float> down, across;  // [rows, rows], and [columns, stride]: transposed
  int reach;
};

// to = down from, both halves (values, weights) of `Cells` each.
void blur_down(const Cells& cells, const Blur& blur, const float* from, float* to) {
  for (int half = 0; half < 2; half++, from += cells.size(), to += cells.size())
    for (int row = 0; row < cells.rows; row += ROWS) {
      const int count = least(ROWS, cells.rows - row), first = most(0, row - blur.reach);
      const int last = least(cells.rows, row + count + blur.reach);
      const float* left = blur.down.data() + int64_t(row) * cells.rows;
      float* out = to + int64_t(row) * cells.stride;
      int column = 0;
      for (; column + 2 * kLanes <= cells.stride; column += 2 * kLanes)
        products<2>(left, cells.rows, count, from + column, cells.stride, first, last, out + column);
      if (column < cells.stride)
        products<1>(left, cells.rows, count, from + column, cells.stride, first, last, out + column);
    }
}

// to = from across^T, both halves at once.
void blur_across(const Cells& cells, const Blur& blur, const float* from, float* to) {
  const auto columns = [&](int column, int count) {
    const int first = most(0, column - blur.reach), last = least(cells.columns, column + count * kLanes + blur.reach);
    const float* right = blur.across.data() + column;
    const auto all = count == 2 ? products<2> : products<1>;
    all(from, cells.stride, 2 * cells.rows, right, cells.stride, first, last, to + column);
  };
  int column = 0;
  for (; column + 2 * kLanes <= cells.stride; column += 2 * kLanes) columns(column, 2);
  if (column < cells.stride) columns(column, 1);
}

// Add to each cell the sum of its part of a row of pixels; N of a cell where that is known when compiled, or 0.
template <int N>
void add_row(const float* row, int columns, int cell, float* out) {
  for (int j = 0; j < columns; j++) {
    float total = 0;
    for (int i = 0; i < N; i++) total += row[j * N + i];
    out[j] += N ? total : sum_of(row + j * cell, cell);
  }
}

// Mean of the known pixels of each cell and how much of it they are; those at the lower and right rim may be cut.
void cell_means(const Field& call, int map, const Cells& cells, float* mean, float* share) {
  const float* bend = call.bend + map * call.bend_stride;
  const uint8_t* known = call.known + int64_t(map) * call.height * call.width;
  std::vector<float> values(int64_t(cells.columns) * call.cell), ones(values.size());
  const auto add = call.cell == 2 ? add_row<2> : call.cell == 4 ? add_row<4> : add_row<0>;
  for (int i = 0; i < cells.rows; i++, mean += cells.stride, share += cells.stride) {
    for (int y = i * call.cell; y < least((i + 1) * call.cell, call.height); y++) {
      const int64_t at = int64_t(y) * call.width;
      for (int x = 0; x < call.width; x++) {
        values[x] = known[at + x] ? bend[at + x] : 0.f;
        ones[x] = float(known[at + x]);
      }
      add(values.data(), cells.columns, call.cell, mean);
      add(ones.data(), cells.columns, call.cell, share);
    }
    for (int j = 0; j < cells.columns; j++) {
      mean[j] /= share[j] > 1 ? share[j] : 1;
      share[j] /= float(call.cell * call.cell);
    }
  }
}

void smooth(const Field& call, int map, const Cells& cells, const std::vector<Blur>& blurs) {
  const int64_t size = cells.size();
  std::vector<float> memory(10 * size, 0.f);
  float *mean = memory.data(), *share = mean + size, *field = share + size, *values = field + size;
  float *weighed = values + size, *between = weighed + 2 * size, *blurred = between + 2 * size;
  cell_means(call, map, cells, mean, share);
  for (const Blur& blur : blurs) {
    for (int64_t i = 0; i < size; i++) {
      values[i] = mean[i] - field[i];
      weighed[i] = share[i] * values[i], weighed[size + i] = share[i];
    }
    for (int round = 0;; round++) {
      blur_down(cells, blur, weighed, between);
      blur_across(cells, blur, between, blurred);
      for (int64_t i = 0; i < size; i++) blurred[i] /= blurred[size + i] + call.prior;
      if (round == call.rounds) break;
      for (int64_t i = 0; i < size; i += kLanes) {
        const Floats value = load<Floats>(values + i), off = value - load<Floats>(blurred + i);
        const Floats weight = load<Floats>(share + i) * call.outlier / root(off * off + call.outlier_squared);
        store(weighed + i, weight * value), store(weighed + size + i, weight);
      }
    }
    for (int64_t i = 0; i < size; i++) field[i] += blurred[i];
  }
  float* out = call.field + int64_t(map) * cells.rows * cells.columns;
  for (int y = 0; y < cells.rows; y++)
    for (int x = 0; x < cells.columns; x++) out[y * cells.columns + x] = field[int64_t(y) * cells.stride + x];
}

}  // namespace
}  // namespace d2

extern "C" int64_t d2_field_size() { return sizeof(d2::Field); }

extern "C" void d2_field(const d2::Field* call) {
  using namespace d2;
  Cells cells;
  cells.rows = (call->height + call->cell - 1) / call->cell;
  cells.columns = (call->width + call->cell - 1) / call->cell;
  cells.stride = (cells.columns + kLanes - 1) / kLanes * kLanes;
  std::vector<Blur> blurs(call->scales);
  for (int scale = 0; scale < call->scales; scale++) {
    const float* down = call->down + int64_t(scale) * cells.rows * cells.rows;
    const float* across = call->across + int64_t(scale) * cells.columns * cells.columns;
    blurs[scale].reach = call->reach[scale];
    blurs[scale].down.assign(down, down + int64_t(cells.rows) * cells.rows);
    blurs[scale].across.assign(int64_t(cells.columns) * cells.stride, 0.f);
    for (int j = 0; j < cells.columns; j++)
      for (int k = 0; k < cells.columns; k++)
        blurs[scale].across[int64_t(k) * cells.stride + j] = across[int64_t(j) * cells.columns + k];
  }
  parallel_for(call->threads, call->maps, [&](int64_t map) { smooth(*call, int(map), cells, blurs); });
}
