// What one call works on: the arrays of a view, laid out as native.py fills them in, and the tiles of its image.
#pragma once

#include <cstdint>

#include "simd.h"
#include "splat.h"

namespace d2 {

// A tile is 8 x 8 blocks, one bit each; a block is one vector of pixels.
constexpr int TILE_BLOCKS = 8, BLOCKS = TILE_BLOCKS * TILE_BLOCKS;
constexpr int TILE_WIDTH = TILE_BLOCKS * BLOCK_WIDTH, TILE_HEIGHT = TILE_BLOCKS * BLOCK_HEIGHT;

// A projected Gaussian in one cache line.
struct alignas(64) Record {
  Footprint<float> footprint;
  uint16_t first_x, first_y, last_x, last_y;  // blocks that it may reach, inclusive; none where last < first
  float color[7];                             // of up to 3 channels; others are read from Frame::colors
};
static_assert(sizeof(Record) == 64, "one cache line");

// Gaussians of a tile, front to back: `live` of them from `begin` on contribute to it.
struct Tile {
  int32_t begin, live;
};

// Per (Gaussian, tile), what the survey adds up.
struct Statistics {
  float weight, error, max_weight, hits;
};

struct Frame {
  Camera camera;
  Constants constants;
  int32_t width, height, channels, threads;
  int32_t chunks;  // parts into which the Gaussians are cut; changes no result
  float eps;
  int64_t count;  // M

  // Inputs; `colors`, `screen_offsets` and `background` may be null.
  const float *means, *covariances, *opacities, *colors, *screen_offsets, *background;
  const float* prior_depth;  // 0 or less, or not finite: not verified
  const uint8_t* verified;

  // State of the forward pass. A pair is a Gaussian in a tile: pairs of Gaussian i have the slots slots[i]..slots[i+1]-1
  // in row-major order of tiles; pairs of a tile stand together in `ids` and `blocks`.
  Record* records;   // [M]
  int32_t* slots;    // [M + 1]
  int32_t* counts;   // [chunks, tiles + 1] pairs per tile, then where they go; the last column sums a chunk
  Tile* tiles;       // [tiles]
  int32_t* ids;      // [pairs]
  uint64_t* blocks;  // [pairs] bit b: contributes to block b; before that, depth and id to sort by

  // Outputs of the forward pass and what comes back to them; null where nothing comes back.
  float *color, *depth_sum, *alpha;
  const float *grad_color, *grad_depth_sum, *grad_alpha;

  // Backward: per slot, whether it was written, and its sums (Moments, then dL/d color), `stride` floats apart.
  uint8_t* touched;
  float* moments;
  float* background_parts;  // [tiles, channels]
  float *grad_means, *grad_covariances, *grad_opacities, *grad_colors, *grad_screen_offsets, *grad_background;

  // Survey; `touched` as above.
  Statistics* statistics;
  float *weight, *error, *max_weight;
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

}  // namespace d2
