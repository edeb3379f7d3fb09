// What one call works on: the arrays of a view, laid out as native.py fills them in, the tiles of its image, and the
// buffers that a thread keeps from call to call.
#pragma once

#include <sys/mman.h>

#include <cstdint>
#include <cstdlib>
#include <new>

#include "simd.h"
#include "splat.h"

namespace d2 {

// A tile is 8 x 8 blocks, one bit each; a block is one vector of pixels.
constexpr int TILE_BLOCKS = 8, BLOCKS = TILE_BLOCKS * TILE_BLOCKS;
constexpr int TILE_WIDTH = TILE_BLOCKS * BLOCK_WIDTH, TILE_HEIGHT = TILE_BLOCKS * BLOCK_HEIGHT;

// A projected Gaussian in one cache line.
struct alignas(64) Record {
  Footprint<float> footprint;
  uint16_t first_x, first_y, last_x, last_y;  // as in Box
  float color[7];                             // of up to 3 channels; others are read from Frame::colors
};
static_assert(sizeof(Record) == 64, "one cache line");

// Gaussians of a tile, front to back: `live` of them, from `begin` on, come before all of its pixels are finished.
struct Tile {
  int32_t begin, live;
};

// Per (Gaussian, tile), what the survey adds up.
struct Statistics {
  float weight, error, hits, front, max_weight;
};

// What binning needs of a projected Gaussian: the blocks that it may reach, inclusive (none where last < first).
struct Box {
  uint16_t first_x, first_y, last_x, last_y;
  float depth;
};

struct Frame {
  Camera camera;
  Constants constants;
  int32_t width, height, channels, threads;
  int32_t chunks;  // parts into which the Gaussians are cut; changes no result
  float eps;
  int64_t count;  // M

  // Inputs; `screen_offsets` may be null, for a survey also `colors` and `background`.
  const float *means, *covariances, *opacities, *colors, *screen_offsets, *background;
  const float *prior_depth, *reliability;  // a pixel counts where both are finite and positive
  const float* near_edge;                  // of the free space; null: there is none

  // State of the forward pass. A pair is a Gaussian in a tile: pairs of Gaussian i have the slots slots[i]..slots[i+1]-1
  // in row-major order of tiles; pairs of a tile stand together in `ids` and `blocks`.
  Record* records;   // [M]; 0 where a Gaussian has no pairs
  int32_t* slots;    // [M + 1]
  Tile* tiles;       // [tiles]
  int32_t* ids;      // [pairs]; -1 behind the live ones of a tile
  uint64_t* blocks;  // [pairs] bit b: may contribute to block b; before that, depth and id to sort by

  // Outputs of the forward pass and what comes back to them; null where nothing comes back.
  float *color, *depth_sum, *alpha, *front;
  const float *grad_color, *grad_depth_sum, *grad_alpha, *grad_front;

  // Gradients; the last may be null.
  float *grad_means, *grad_covariances, *grad_opacities, *grad_colors, *grad_screen_offsets;

  // Survey.
  float *weight, *error, *max_weight, *front_weight;
  int32_t* hits;

  int tiles_x() const { return (width + TILE_WIDTH - 1) / TILE_WIDTH; }
  int tiles_y() const { return (height + TILE_HEIGHT - 1) / TILE_HEIGHT; }
  int tile_count() const { return tiles_x() * tiles_y(); }
  int64_t chunk_begin(int64_t chunk) const {
    const int64_t groups = (count + LANES - 1) / LANES, begin = groups * chunk / chunks * LANES;
    return begin < count ? begin : count;
  }
  float log2_alpha_min() const { return d2::log2(constants.alpha_min); }
  float log2_alpha_max() const { return d2::log2(constants.alpha_max); }
};

// Asks for pages of 2 MB where memory is read at random: with small ones most of the time goes into finding them.
inline void ask_for_large_pages(void* memory, size_t bytes) {
#if defined(MADV_HUGEPAGE)
  const uintptr_t page = uintptr_t(2) << 20, begin = uintptr_t(memory), end = begin + bytes;
  const uintptr_t first = (begin + page - 1) / page * page, last = end / page * page;
  if (last > first) madvise(reinterpret_cast<void*>(first), last - first, MADV_HUGEPAGE);
#endif
}

// Memory that only grows, so that a training loop does not pay for fresh pages in every step.
template <class T>
class Buffer {
 public:
  ~Buffer() { std::free(data_); }
  T* reserve(size_t count) {
    if (count > capacity_) {
      std::free(data_);
      capacity_ = 0;  // so that a call after one without memory asks again
      const size_t page = size_t(2) << 20, wanted = (count + count / 4) * sizeof(T);
      const size_t alignment = wanted < page ? 64 : page, bytes = (wanted + alignment - 1) / alignment * alignment;
      data_ = static_cast<T*>(std::aligned_alloc(alignment, bytes));
      if (!data_) throw std::bad_alloc();
      capacity_ = count + count / 4;
      ask_for_large_pages(data_, bytes);
    }
    return data_;
  }
  T* data() const { return data_; }

 private:
  T* data_ = nullptr;
  size_t capacity_ = 0;
};

// Buffers of a thread. The first group belongs to the thread that calls, and lives at least through one call (`boxes`
// and `counts` from d2_project to the step that follows it); the second to every thread that works on tiles.
struct Scratch {
  Buffer<Box> boxes;                // [M]
  Buffer<int32_t> counts;           // [chunks, tiles + 1] pairs per tile, then where they go; last: pairs of the chunk
  Buffer<uint8_t> touched;          // [pairs] whether the slot was written
  Buffer<float> moments;            // [pairs, stride] per slot: Moments, then dL/d color
  Buffer<Statistics> statistics;    // [pairs] per slot

  Buffer<uint64_t> keys, spare;     // [pairs of the tile]
  Buffer<float> state;              // fields of the tile's blocks
};
inline Scratch& scratch() {
  static thread_local Scratch buffers;
  return buffers;
}

// Floats between the moments of two slots: whole cache lines.
inline int64_t moment_stride(int channels) { return (7 + channels + 15) / 16 * 16; }

// Column `column` of up to LANES rows of a row-major array; lanes from `rows` on are 0.
D2_INLINE Floats load_column(const float* row, int64_t stride, int column, int rows) {
  alignas(64) float lane[LANES] = {};
  for (int i = 0; i < rows; i++) lane[i] = row[i * stride + column];
  return Floats::load(lane);
}

D2_INLINE void store_column(Floats values, float* row, int64_t stride, int column, int rows) {
  alignas(64) float lane[LANES];
  values.store(lane);
  for (int i = 0; i < rows; i++) row[i * stride + column] = lane[i];
}

// All N columns of up to LANES rows.
template <int N>
D2_INLINE void load_columns(const float* row, int rows, Floats (&out)[N]) {
  if (rows == LANES) return load_rows<N>(row, out);
  for (int n = 0; n < N; n++) out[n] = load_column(row, N, n, rows);
}
template <int N>
D2_INLINE void store_columns(const Floats (&columns)[N], float* row, int rows) {
  if (rows == LANES) return store_rows<N>(columns, row);
  for (int n = 0; n < N; n++) store_column(columns[n], row, N, n, rows);
}

}  // namespace d2
