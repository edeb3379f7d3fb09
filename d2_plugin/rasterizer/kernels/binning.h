// From Gaussians in the world to lists of Gaussians per tile, front to back.
//
// Three steps: project Gaussians and count pairs per tile, chunk by chunk; turn counts into places; put every pair in
// its place and sort each tile by depth (when it is drawn). Pairs enter a tile in the order of Gaussian indices and the
// sort is stable, so that equal depths keep that order and no result depends on the number of chunks or threads.
#pragma once

#include <algorithm>

#include "frame.h"
#include "parallel.h"

namespace d2 {

template <class Visit>
D2_INLINE void for_each_tile(const Box& b, int tiles_x, Visit visit) {
  if (b.last_x < b.first_x) return;
  for (int y = b.first_y / TILE_BLOCKS; y <= b.last_y / TILE_BLOCKS; y++)
    for (int x = b.first_x / TILE_BLOCKS; x <= b.last_x / TILE_BLOCKS; x++) visit(y * tiles_x + x);
}

// First and last block along one axis whose pixel centres lie within `reach` of `center`, and whether there are any.
D2_INLINE Mask block_range(Floats center, Floats reach, int size, float block, float* first, float* last) {
  const Floats margin = fma(reach, Floats(1e-5f), Floats(1e-4f));  // rounding of the bound must not cut a fragment
  const Floats low = max(-floor(-(center - reach - margin - Floats(0.5f))), Floats(0.f));
  const Floats high = min(floor(center + reach + margin - Floats(0.5f)), Floats(float(size - 1)));
  const Mask some = high >= low;
  where(some, floor(low * Floats(1 / block))).store(first);
  where(some, floor(high * Floats(1 / block))).store(last);
  return some;
}

D2_INLINE Gaussian<Floats> load_gaussians(const Frame& f, int64_t i, int rows) {
  Gaussian<Floats> g;
  load_columns(f.means + 3 * i, rows, g.mean);
  load_columns(f.covariances + 6 * i, rows, g.covariance);
  g.opacity = load_column(f.opacities + i, 1, 0, rows);
  return g;
}

// Screen offsets.
D2_INLINE void load_offsets(const Frame& f, int64_t i, int rows, Floats (&offsets)[2]) {
  offsets[0] = offsets[1] = Floats(0.f);
  if (f.screen_offsets) load_columns(f.screen_offsets + 2 * i, rows, offsets);
}

// The colors that a record has room for, and whether all are finite.
D2_INLINE Mask load_colors(const Frame& f, int64_t i, int rows, Floats (&colors)[3]) {
  Floats zero = 0.f;
  for (int c = 0; c < 3; c++) colors[c] = Floats(0.f);
  if (f.colors && f.channels == 3) {
    load_columns(f.colors + 3 * i, rows, colors);
    for (int c = 0; c < 3; c++) zero = zero + colors[c] * Floats(0.f);
  } else if (f.colors) {
    for (int c = 0; c < f.channels; c++)
      zero = zero + load_column(f.colors + i * f.channels, f.channels, c, rows) * Floats(0.f);
  }
  return zero >= Floats(0.f);
}

// Puts a group of Gaussians into records, those that are not `drawn` as 0.
D2_INLINE void store_records(const Footprint<Floats>& s, const Floats (&colors)[3], const float (&box)[4][LANES],
                             unsigned drawn, int rows, Record* records) {
  alignas(64) uint32_t packed[2][LANES];  // first and last block, as in Record
  for (int lane = 0; lane < LANES; lane++) {
    packed[0][lane] = uint32_t(box[0][lane]) | uint32_t(box[1][lane]) << 16;
    packed[1][lane] = uint32_t(box[2][lane]) | uint32_t(box[3][lane]) << 16;
  }
#if defined(D2_AVX512)
  Floats m[LANES] = {s.x, s.y, s.ux, s.uy, s.vy, s.log2_opacity, s.depth};
  for (int k = 0; k < 2; k++) m[7 + k] = Floats::load(reinterpret_cast<const float*>(packed[k]));
  for (int c = 0; c < 7; c++) m[9 + c] = c < 3 ? colors[c] : Floats(0.f);
  transpose(m);
  for (int lane = 0; lane < rows; lane++)
    (drawn >> lane & 1 ? m[lane] : Floats(0.f)).store(reinterpret_cast<float*>(records + lane));
#else
  alignas(64) float fields[10][LANES];
  const Floats* parts[10] = {&s.x, &s.y, &s.ux, &s.uy, &s.vy, &s.log2_opacity, &s.depth, colors, colors + 1, colors + 2};
  for (int k = 0; k < 10; k++) parts[k]->store(fields[k]);
  for (int lane = 0; lane < rows; lane++) {
    Record& r = records[lane];
    r = {};
    if (!(drawn >> lane & 1)) continue;
    float* number = reinterpret_cast<float*>(&r);
    for (int k = 0; k < 7; k++) number[k] = fields[k][lane];
    std::memcpy(&r.first_x, &packed[0][lane], 4), std::memcpy(&r.last_x, &packed[1][lane], 4);
    for (int c = 0; c < 3; c++) r.color[c] = fields[7 + c][lane];
  }
#endif
}

D2_INLINE void project_group(const Frame& f, int64_t i, int rows, Box* boxes, int32_t* counts) {
  Floats offsets[2], colors[3];
  load_offsets(f, i, rows, offsets);
  const Mask finite = load_colors(f, i, rows, colors);
  const Projected<Floats> p = project(load_gaussians(f, i, rows), offsets[0], offsets[1], f.camera, f.constants);
  const Footprint<Floats>& s = p.footprint;
  alignas(64) float box[4][LANES], depth[LANES];  // first_x, first_y, last_x, last_y
  const Mask across = block_range(s.x, p.reach.x, f.width, BLOCK_WIDTH, box[0], box[2]);
  const Mask down = block_range(s.y, p.reach.y, f.height, BLOCK_HEIGHT, box[1], box[3]);
  s.depth.store(depth);
  const unsigned drawn = lanes(p.visible & finite & across & down);
  store_records(s, colors, box, drawn, rows, f.records + i);
  const int tiles_x = f.tiles_x();
  for (int lane = 0; lane < rows; lane++) {
    if (!(drawn >> lane & 1)) {
      boxes[i + lane] = {1, 1, 0, 0, 0.f};
      continue;
    }
    const Box here = {uint16_t(box[0][lane]), uint16_t(box[1][lane]), uint16_t(box[2][lane]), uint16_t(box[3][lane]),
                      depth[lane]};
    boxes[i + lane] = here;
    for_each_tile(here, tiles_x, [&](int tile) { counts[tile]++; });
  }
}

// Fills records, boxes and counts; returns the number of pairs.
inline int64_t project_all(const Frame& f) {
  const int tiles = f.tile_count();
  ask_for_large_pages(f.records, sizeof(Record) * f.count);
  Box* boxes = scratch().boxes.reserve(f.count);
  int32_t* all_counts = scratch().counts.reserve(size_t(f.chunks) * (tiles + 1));
  parallel_for(f.threads, f.chunks, [&](int64_t chunk) {
    int32_t* counts = all_counts + chunk * (tiles + 1);
    std::fill(counts, counts + tiles + 1, 0);
    const int64_t end = f.chunk_begin(chunk + 1);
    int64_t i = f.chunk_begin(chunk);
    for (; i + LANES <= end; i += LANES) project_group(f, i, LANES, boxes, counts);
    if (i < end) project_group(f, i, int(end - i), boxes, counts);
  });
  int64_t pairs = 0;
  for (int tile = 0; tile < tiles; tile++)
    for (int chunk = 0; chunk < f.chunks; chunk++) {
      int32_t* counts = all_counts + int64_t(chunk) * (tiles + 1);
      const int32_t here = counts[tile];
      counts[tile] = int32_t(pairs);
      counts[tiles] += here;
      pairs += here;
    }
  return pairs;
}

// A positive float's bits order like the float; the index below makes the order of equal depths that of the indices.
D2_INLINE uint64_t sort_key(float depth, int64_t index) {
  uint32_t bits;
  std::memcpy(&bits, &depth, sizeof bits);
  return uint64_t(bits) << 32 | uint64_t(index);
}

// Puts every pair into its tile, in the order of Gaussian indices.
inline void distribute(const Frame& f, int64_t pairs) {
  const int tiles = f.tile_count(), tiles_x = f.tiles_x();
  const Box* boxes = scratch().boxes.data();
  int32_t* all_counts = scratch().counts.data();
  for (int tile = 0; tile < tiles; tile++) {
    const int32_t begin = all_counts[tile], end = tile + 1 < tiles ? all_counts[tile + 1] : int32_t(pairs);
    f.tiles[tile] = {begin, end - begin};
  }
  int32_t first_slot = 0;
  for (int chunk = 0; chunk < f.chunks; chunk++) {
    int32_t& here = all_counts[int64_t(chunk) * (tiles + 1) + tiles];
    first_slot += here;
    here = first_slot - here;
  }
  f.slots[f.count] = int32_t(pairs);
  parallel_for(f.threads, f.chunks, [&](int64_t chunk) {
    int32_t* place = all_counts + chunk * (tiles + 1);
    int32_t slot = place[tiles];
    const int64_t end = f.chunk_begin(chunk + 1);
    for (int64_t i = f.chunk_begin(chunk); i < end; i++) {
      f.slots[i] = slot;
      const uint64_t key = sort_key(boxes[i].depth, i);
      for_each_tile(boxes[i], tiles_x, [&](int tile) {
        f.blocks[place[tile]++] = key;
        slot++;
      });
    }
  });
}

// Sorts keys by depth, stable: by radix on the digits in which depths differ, or by insertion where they are few.
inline const uint64_t* sort_by_depth(const uint64_t* keys, int count) {
  uint64_t *out = scratch().keys.reserve(count), *spare = scratch().spare.reserve(count);
  uint32_t low = ~0u, high = 0;
  for (int i = 0; i < count; i++) {
    const uint32_t depth = uint32_t(keys[i] >> 32);
    low = std::min(low, depth), high = std::max(high, depth);
    out[i] = keys[i];
  }
  if (count <= 48) {
    for (int i = 1; i < count; i++) {
      const uint64_t key = out[i];
      int k = i;
      for (; k > 0 && out[k - 1] > key; k--) out[k] = out[k - 1];
      out[k] = key;
    }
    return out;
  }
  const int bits = high > low ? 32 - __builtin_clz(high - low) : 0;
  const int passes = (bits + 9) / 10, digit = passes ? (bits + passes - 1) / passes : 0;
  int32_t places[1 << 10];
  for (int pass = 0; pass < passes; pass++) {
    const int shift = pass * digit;
    const uint32_t mask = (1u << digit) - 1;
    std::fill(places, places + (1 << digit), 0);
    const auto bucket = [&](uint64_t key) { return (uint32_t(key >> 32) - low) >> shift & mask; };
    for (int i = 0; i < count; i++) places[bucket(out[i])]++;
    int32_t total = 0;
    for (int b = 0; b < 1 << digit; b++) {
      const int32_t here = places[b];
      places[b] = total;
      total += here;
    }
    for (int i = 0; i < count; i++) spare[places[bucket(out[i])]++] = out[i];
    std::swap(out, spare);
  }
  return out;
}

}  // namespace d2
