// Splatting on the CPU: tiles on threads, blocks of pixels in vectors, Gaussians front to back.
//
// The loop over Gaussians is the outer one: a block's pixels stay in the L1 cache while a Gaussian visits the blocks
// that it reaches, and its constants stay in registers. The backward pass runs front to back as well, peeling what a
// Gaussian hides off the pixel's total, so that the forward pass has no lists per pixel to save. Sums over pixels go to
// one slot per (Gaussian, tile) and are added up in the order of tiles: the same bits for any number of threads.
#include <type_traits>

#include "binning.h"

namespace d2 {

struct Corner {
  int x, y;  // pixels
};
D2_INLINE Corner corner_of(const Frame& f, int tile) {
  return {tile % f.tiles_x() * TILE_WIDTH, tile / f.tiles_x() * TILE_HEIGHT};
}

// The pixels of a block that lie inside the image.
struct Patch {
  int64_t pixel;      // the first one
  int stride;         // of the image
  int columns, rows;  // 1..BLOCK_WIDTH, 1..BLOCK_HEIGHT

  D2_INLINE unsigned lanes() const {
    unsigned row = (1u << columns) - 1, all = 0;
    for (int y = 0; y < rows; y++) all |= row << y * BLOCK_WIDTH;
    return all;
  }
};

// Calls visit(block, patch, whole) for the blocks of a tile that the image touches; `whole` is a constant, true where
// all of the block's pixels are in the image.
template <class Visit>
D2_INLINE void for_each_block(const Frame& f, int tile, Visit visit) {
  const Corner corner = corner_of(f, tile);
  for (int block = 0; block < BLOCKS; block++) {
    const int x = corner.x + block % TILE_BLOCKS * BLOCK_WIDTH, y = corner.y + block / TILE_BLOCKS * BLOCK_HEIGHT;
    if (x >= f.width || y >= f.height) continue;
    const Patch patch = {int64_t(y) * f.width + x, f.width, std::min(BLOCK_WIDTH, f.width - x),
                         std::min(BLOCK_HEIGHT, f.height - y)};
    if (patch.columns == BLOCK_WIDTH && patch.rows == BLOCK_HEIGHT)
      visit(block, patch, std::true_type());
    else
      visit(block, patch, std::false_type());
  }
}

// Number `channel` of `channels` per pixel, to and from a block; lanes outside of the image are 0 and are not written.
D2_INLINE Floats load_part(const float* image, int channels, int channel, const Patch& p) {
  alignas(64) float lane[LANES] = {};
  for (int y = 0; y < p.rows; y++)
    for (int x = 0; x < p.columns; x++)
      lane[y * BLOCK_WIDTH + x] = image[(p.pixel + int64_t(y) * p.stride + x) * channels + channel];
  return Floats::load(lane);
}
D2_INLINE void store_part(Floats values, float* image, int channels, int channel, const Patch& p) {
  alignas(64) float lane[LANES];
  values.store(lane);
  for (int y = 0; y < p.rows; y++)
    for (int x = 0; x < p.columns; x++)
      image[(p.pixel + int64_t(y) * p.stride + x) * channels + channel] = lane[y * BLOCK_WIDTH + x];
}

// One number per pixel.
template <bool WHOLE>
D2_INLINE Floats load_plane(const float* plane, const Patch& p) {
  return WHOLE ? load_block(plane + p.pixel, p.stride) : load_part(plane, 1, 0, p);
}
template <bool WHOLE>
D2_INLINE void store_plane(Floats values, float* plane, const Patch& p) {
  WHOLE ? store_block(values, plane + p.pixel, p.stride) : store_part(values, plane, 1, 0, p);
}

// The transmittance that a block begins with: nothing reaches the lanes outside of the image.
template <bool WHOLE>
D2_INLINE Floats untouched(const Patch& p) {
  if (WHOLE) return Floats(1.f);
  alignas(64) float lane[LANES];
  for (int i = 0; i < LANES; i++) lane[i] = p.lanes() >> i & 1;
  return Floats::load(lane);
}

// Calls visit(channel, values) for the numbers of a pixel; three of them are unwoven together.
template <int FIXED, bool WHOLE, class Visit>
D2_INLINE void load_channels(const float* image, int channels, const Patch& p, Visit visit) {
  if (FIXED == 3 && WHOLE) {
    Floats woven[3], parts[3];
    for (int k = 0; k < 3; k++) woven[k] = load_block(image + 3 * p.pixel + k * BLOCK_WIDTH, 3 * int64_t(p.stride));
    unweave<BLOCK_WIDTH, 3>(woven, parts);
    for (int c = 0; c < 3; c++) visit(c, parts[c]);
  } else {
    for (int c = 0; c < channels; c++) visit(c, load_part(image, channels, c, p));
  }
}
// The other way: `value(channel)` gives them.
template <int FIXED, bool WHOLE, class Value>
D2_INLINE void store_channels(float* image, int channels, const Patch& p, Value value) {
  if (FIXED == 3 && WHOLE) {
    const Floats parts[3] = {value(0), value(1), value(2)};
    Floats woven[3];
    weave<BLOCK_WIDTH, 3>(parts, woven);
    for (int k = 0; k < 3; k++)
      store_block(woven[k], image + 3 * p.pixel + k * BLOCK_WIDTH, 3 * int64_t(p.stride));
  } else {
    for (int c = 0; c < channels; c++) store_part(value(c), image, channels, c, p);
  }
}

// Where the blocks of a tile are, in pixels from its corner: first pixel centre of each.
struct Blocks {
  float right[BLOCKS], down[BLOCKS];
};
static constexpr Blocks block_places() {
  Blocks b{};
  for (int i = 0; i < BLOCKS; i++) {
    b.right[i] = i % TILE_BLOCKS * BLOCK_WIDTH + 0.5f;
    b.down[i] = i / TILE_BLOCKS * BLOCK_HEIGHT + 0.5f;
  }
  return b;
}
alignas(64) static constexpr Blocks PLACES = block_places();

// A Gaussian over the pixels of one tile.
struct Spread {
  const Footprint<float>& footprint;
  float x, y;     // centre, from the tile's corner
  Floats u0, v0;  // u and v at the pixels of a block that starts at the corner, less the half pixel in PLACES

  D2_INLINE Spread(const Footprint<float>& f, Corner corner, Floats lane_x, Floats lane_y)
      : footprint(f), x(f.x - corner.x), y(f.y - corner.y) {
    const Floats dx = lane_x - Floats(x), dy = lane_y - Floats(y);
    u0 = along_u(f, dx, dy), v0 = along_v(f, dy);
  }

  D2_INLINE Fragment<Floats> at(int block) const {
    const Footprint<float>& f = footprint;
    const Floats right = PLACES.right[block], down = PLACES.down[block];
    const Floats u = fma(Floats(f.ux), right, fma(Floats(f.uy), down, u0)), v = fma(Floats(f.vy), down, v0);
    return fragment(f.log2_opacity, u, v);
  }

  // The blocks where it may reach alpha_min, one bit each: bounds u and v over each block separately.
  D2_INLINE uint64_t blocks(const Record& r, Corner corner, float log2_alpha_min) const {
    const Footprint<float>& f = footprint;
    const int top = corner.y / BLOCK_HEIGHT;
    const int first = std::max(r.first_y - top, 0), last = std::min(r.last_y - top, TILE_BLOCKS - 1);
    constexpr float half_x = 0.5f * (BLOCK_WIDTH - 1), half_y = 0.5f * (BLOCK_HEIGHT - 1);
    const Floats spread_u = f.ux * half_x + __builtin_fabsf(f.uy) * half_y, spread_v = f.vy * half_y;
    const Floats budget = (f.log2_opacity - log2_alpha_min) * 1.0001f + 1e-4f;  // generous to rounding
    uint64_t found = 0;
    for (int i = first * TILE_BLOCKS / LANES; i <= (last * TILE_BLOCKS + TILE_BLOCKS - 1) / LANES; i++) {
      const Floats dx = Floats::load(PLACES.right + i * LANES) + Floats(half_x - x);
      const Floats dy = Floats::load(PLACES.down + i * LANES) + Floats(half_y - y);
      const Floats u = max(abs(along_u(f, dx, dy)) - spread_u, Floats(0.f));
      const Floats v = max(abs(along_v(f, dy)) - spread_v, Floats(0.f));
      found |= uint64_t(lanes(fma(u, u, v * v) <= budget)) << (i * LANES);
    }
    return found;
  }
};

// Pixels of a block, from its first.
struct Lattice {
  Floats x, y;
  Lattice() {
    alignas(64) float along_x[LANES], along_y[LANES];
    for (int lane = 0; lane < LANES; lane++) along_x[lane] = lane % BLOCK_WIDTH, along_y[lane] = lane / BLOCK_WIDTH;
    x = Floats::load(along_x), y = Floats::load(along_y);
  }
  D2_INLINE Spread spread(const Record& r, Corner corner) const { return {r.footprint, corner, x, y}; }
};

// Calls visit(id, record, blocks) for the Gaussians of a tile front to back, with the blocks that they may reach among
// those still `alive`; ends when none is. Which blocks is found out for a batch ahead, since the loop over them ends
// unpredictably: the sooner the processor knows when, the less it does in vain.
template <class Visit>
D2_INLINE void for_each_reaching(const Frame& f, const uint64_t* keys, int pairs, Corner corner, uint64_t& alive,
                                 Visit visit) {
  constexpr int BATCH = 32;
  const Lattice lattice;
  const float log2_alpha_min = f.log2_alpha_min();
  uint64_t blocks[BATCH];
  for (int i = 0; i < std::min(BATCH, pairs); i++) __builtin_prefetch(f.records + uint32_t(keys[i]));
  for (int first = 0; first < pairs && alive; first += BATCH) {
    const int count = std::min(BATCH, pairs - first), ahead = std::min(2 * BATCH, pairs - first) - BATCH;
    for (int i = 0; i < count; i++) {
      const Record& r = f.records[uint32_t(keys[first + i])];
      blocks[i] = lattice.spread(r, corner).blocks(r, corner, log2_alpha_min);
    }
    for (int i = 0; i < count; i++) {
      // The records of a batch arrive, one by one, while the batch before it is drawn.
      if (i < ahead) __builtin_prefetch(f.records + uint32_t(keys[first + BATCH + i]));
      const uint32_t id = uint32_t(keys[first + i]);
      if (const uint64_t reached = blocks[i] & alive) visit(id, f.records[id], reached);
    }
  }
}

// Slot of the pair (Gaussian `id`, tile).
D2_INLINE int64_t slot_of(const Frame& f, const Record& r, int32_t id, Corner corner) {
  const int x0 = r.first_x / TILE_BLOCKS, y0 = r.first_y / TILE_BLOCKS, across = r.last_x / TILE_BLOCKS - x0 + 1;
  return f.slots[id] + int64_t(corner.y / TILE_HEIGHT - y0) * across + (corner.x / TILE_WIDTH - x0);
}

// ---------------------------------------------------------------------------------------------------- forward

// The unfinished pixels of a tile. A pixel that finishes keeps its transmittance in `last` and goes on with 0, so that
// nothing contributes any more; that happens once per pixel, hence aside from the arithmetic of every fragment.
struct Unfinished {
  unsigned lanes[BLOCKS] = {};  // one bit per pixel of a block
  uint64_t blocks = 0;          // one bit per block that has any

  D2_INLINE void add(int block, const Patch& patch) {
    lanes[block] = patch.lanes();
    blocks |= uint64_t(1) << block;
  }
  D2_INLINE Floats advance(const Step<Floats>& step, Floats transmittance, int block, float* last) {
    const unsigned open = d2::lanes(step.open);
    if (open != lanes[block]) {
      max(Floats::load(last), select(step.open, Floats(0.f), transmittance)).store(last);
      lanes[block] = open;
      if (!open) blocks &= ~(uint64_t(1) << block);
    }
    return where(step.open, step.after);
  }
};

// Fields `near` and `scale` of a block's state, one after the other.
D2_INLINE FreeSpace<Floats> load_space(const float* near) { return {Floats::load(near), Floats::load(near + LANES)}; }

// State of a block in the forward pass: transmittance, that of finished pixels, depth sum, colors; with FRONT the near
// edge and the sum of w max(0, D_near - z).
template <int FIXED, bool FRONT>
static void render_tile(const Frame& f, int tile) {
  const int channels = FIXED ? FIXED : f.channels, edge = 3 + channels, fields = edge + (FRONT ? 2 : 0);
  float* state = scratch().state.reserve(size_t(BLOCKS) * fields * LANES);
  Unfinished unfinished;
  for_each_block(f, tile, [&](int block, const Patch& patch, auto whole) {
    float* field = state + block * fields * LANES;
    untouched<whole>(patch).store(field);
    for (int k = 1; k < fields; k++) Floats(0.f).store(field + k * LANES);
    if (FRONT) free_space(load_plane<whole>(f.near_edge, patch)).near.store(field + edge * LANES);
    unfinished.add(block, patch);
  });

  const Corner corner = corner_of(f, tile);
  const Lattice lattice;
  const float log2_alpha_min = f.log2_alpha_min();
  const int32_t begin = f.tiles[tile].begin, pairs = f.tiles[tile].live;
  const uint64_t* keys = sort_by_depth(f.blocks + begin, pairs);
  int32_t live = begin;
  for_each_reaching(f, keys, pairs, corner, unfinished.blocks, [&](uint32_t id, const Record& r, uint64_t reached) {
    const float* color = FIXED ? r.color : f.colors + int64_t(id) * channels;
    const Spread spread = lattice.spread(r, corner);
    for (uint64_t left = reached; left; left &= left - 1) {
      const int block = __builtin_ctzll(left);
      const Fragment<Floats> here = spread.at(block);
      float* field = state + block * fields * LANES;
      const Floats transmittance = Floats::load(field);
      const Step<Floats> step = composite(here.log2_alpha, transmittance, log2_alpha_min, f.constants);
      unfinished.advance(step, transmittance, block, field + LANES).store(field);
      const auto add = [&](int k, Floats value) {
        fma(step.weight, value, Floats::load(field + k * LANES)).store(field + k * LANES);
      };
      add(2, r.footprint.depth);
      for (int c = 0; c < channels; c++) add(3 + c, color[c]);
      if (FRONT) add(edge + 1, before_edge(Floats::load(field + edge * LANES), Floats(r.footprint.depth)));
    }
    f.ids[live] = int32_t(id), f.blocks[live++] = reached;
  });
  f.tiles[tile].live = live - begin;
  std::fill(f.ids + live, f.ids + begin + pairs, -1);

  for_each_block(f, tile, [&](int block, const Patch& patch, auto whole) {
    const float* field = state + block * fields * LANES;
    const auto part = [&](int k) { return Floats::load(field + k * LANES); };
    const Floats transmittance = max(part(0), part(1));
    store_plane<whole>(Floats(1.f) - transmittance, f.alpha, patch);
    store_plane<whole>(part(2), f.depth_sum, patch);
    if (FRONT) {
      const Floats scale = free_space(load_plane<whole>(f.near_edge, patch)).scale;
      store_plane<whole>(part(edge + 1) * scale, f.front, patch);
    }
    store_channels<FIXED, whole>(f.color, channels, patch,
                                 [&](int c) { return fma(transmittance, Floats(f.background[c]), part(3 + c)); });
  });
}

// ---------------------------------------------------------------------------------------------------- backward

// State of a block in the backward pass: transmittance, what is left of sum of w dL/dw, and dL/d of alpha (with the
// background's share), depth sum and colors at its pixels; with FRONT the free space (2), scaled by dL/d(front).
template <int FIXED, bool FRONT>
static void load_gradients(const Frame& f, int tile, float* state) {
  const int channels = FIXED ? FIXED : f.channels, space = 4 + channels, fields = space + (FRONT ? 2 : 0);
  for_each_block(f, tile, [&](int block, const Patch& patch, auto whole) {
    float* field = state + block * fields * LANES;
    const Floats alpha = load_plane<whole>(f.alpha, patch);
    // Where nobody contributes nothing comes back: a loss that divides by alpha sends NaN there, which 0 times a weight
    // would not silence.
    const Mask drawn = alpha > Floats(0.f);
    const auto upstream = [&](const float* plane) {
      return plane ? where(drawn, load_plane<whole>(plane, patch)) : Floats(0.f);
    };
    Floats on_alpha = upstream(f.grad_alpha);
    const Floats on_depth = upstream(f.grad_depth_sum);
    Floats total = fma(on_alpha, alpha, on_depth * load_plane<whole>(f.depth_sum, patch));
    if (FRONT) {
      // Nothing comes back either where no space is known to be free.
      const FreeSpace<Floats> known = free_space(load_plane<whole>(f.near_edge, patch));
      const Floats on_front = where(known.scale > Floats(0.f), upstream(f.grad_front));
      known.near.store(field + space * LANES);
      (known.scale * on_front).store(field + (space + 1) * LANES);
      total = fma(on_front, load_plane<whole>(f.front, patch), total);
    }
    for (int c = 0; c < channels; c++) Floats(0.f).store(field + (4 + c) * LANES);
    if (f.grad_color) {
      load_channels<FIXED, whole>(f.grad_color, channels, patch, [&](int c, Floats given) {
        const Floats on_color = where(drawn, given), behind = f.background[c];
        on_color.store(field + (4 + c) * LANES);
        // The image holds (1 - A) background: part of the dependence on alpha, not of the sum over Gaussians.
        on_alpha = fnma(on_color, behind, on_alpha);
      });
      load_channels<FIXED, whole>(f.color, channels, patch, [&](int c, Floats color) {
        total = fma(Floats::load(field + (4 + c) * LANES), color - Floats(f.background[c]), total);
      });
    }
    untouched<whole>(patch).store(field);
    total.store(field + LANES);
    on_alpha.store(field + 2 * LANES);
    on_depth.store(field + 3 * LANES);
  });
}

// Where the tiles of one call put their sums: `Scratch` of the thread that calls.
struct Sums {
  uint8_t* touched;
  float* moments;
};

template <int FIXED, bool FRONT>
static void backward_tile(const Frame& f, int tile, const Sums& to) {
  const int channels = FIXED ? FIXED : f.channels, free = 4 + channels, fields = free + (FRONT ? 2 : 0);
  float* state = scratch().state.reserve(size_t(BLOCKS * fields + 7 + channels) * LANES);
  Floats* loose_sums = reinterpret_cast<Floats*>(state + BLOCKS * fields * LANES);
  load_gradients<FIXED, FRONT>(f, tile, state);
  const Corner corner = corner_of(f, tile);
  const Lattice lattice;
  const float log2_alpha_min = f.log2_alpha_min(), log2_alpha_max = f.log2_alpha_max();
  const int64_t stride = moment_stride(channels);
  const int32_t begin = f.tiles[tile].begin, end = begin + f.tiles[tile].live;
  for (int32_t q = begin; q < end; q++) {
    if (q + 16 < end) {
      __builtin_prefetch(f.records + f.ids[q + 16]);
      __builtin_prefetch(f.slots + f.ids[q + 16]);
    }
    if (q + 8 < end) {
      const int32_t soon = f.ids[q + 8];
      __builtin_prefetch(to.moments + slot_of(f, f.records[soon], soon, corner) * stride, 1);
    }
    const int32_t id = f.ids[q];
    const Record& r = f.records[id];
    const float* color = FIXED ? r.color : f.colors + int64_t(id) * channels;
    Floats fixed_sums[7 + (FIXED ? FIXED : 1)];
    Floats* sums = FIXED ? fixed_sums : loose_sums;
    for (int k = 0; k < 7 + channels; k++) sums[k] = Floats(0.f);
    const Spread spread = lattice.spread(r, corner);
    for (uint64_t left = f.blocks[q]; left; left &= left - 1) {
      const int block = __builtin_ctzll(left);
      const Fragment<Floats> here = spread.at(block);
      float* field = state + block * fields * LANES;
      const Floats transmittance = Floats::load(field);
      const Step<Floats> step = composite(here.log2_alpha, transmittance, log2_alpha_min, f.constants);
      const Floats depth = r.footprint.depth;
      Floats on_depth = Floats::load(field + 3 * LANES);
      Floats value = fma(on_depth, depth, Floats::load(field + 2 * LANES));
      if (FRONT) {
        const FreeSpace<Floats> space = load_space(field + free * LANES);
        value = value + in_front(space, depth);
        on_depth = on_depth - in_front_gradient(space, depth);
      }
      for (int c = 0; c < channels; c++) {
        const Floats on_color = Floats::load(field + (4 + c) * LANES);
        value = fma(on_color, Floats(color[c]), value);
        sums[7 + c] = fma(step.weight, on_color, sums[7 + c]);
      }
      const Floats behind = fnma(step.weight, value, Floats::load(field + LANES));
      const Floats g = log_alpha_gradient(step, here.log2_alpha, transmittance, value, behind, log2_alpha_max);
      const Floats gu = g * here.u, gv = g * here.v;
      sums[0] = sums[0] + g;
      sums[1] = sums[1] + gu;
      sums[2] = sums[2] + gv;
      sums[3] = fma(gu, here.u, sums[3]);
      sums[4] = fma(gu, here.v, sums[4]);
      sums[5] = fma(gv, here.v, sums[5]);
      sums[6] = fma(step.weight, on_depth, sums[6]);
      where(step.open, step.after).store(field);
      behind.store(field + LANES);
    }
    const int64_t slot = slot_of(f, r, id, corner);
    to.touched[slot] = 1;
    float* moments = to.moments + slot * stride;
    if (FIXED)
      store_sums<7 + FIXED>(fixed_sums, moments);
    else
      for (int k = 0; k < 7 + channels; k++) moments[k] = sum(sums[k]);
  }
}

// Adds up the slots of a Gaussian, in the order of tiles; false if it has none.
D2_INLINE bool gather_moments(const Frame& f, const Sums& from, int64_t i, int64_t stride, float* total) {
  bool any_slot = false;
  std::fill(total, total + stride, 0.f);
  for (int64_t slot = f.slots[i]; slot < f.slots[i + 1]; slot++) {
    if (!from.touched[slot]) continue;
    const float* part = from.moments + slot * stride;
    for (int64_t k = 0; k < stride; k += LANES) (Floats::load(total + k) + Floats::load(part + k)).store(total + k);
    any_slot = true;
  }
  return any_slot;
}

template <int FIXED>
static void backward_group(const Frame& f, const Sums& from, int64_t i, int rows, float* totals) {
  const int channels = FIXED ? FIXED : f.channels;
  const int64_t stride = moment_stride(channels);
  alignas(64) float drawn[LANES] = {};
  for (int lane = 0; lane < rows; lane++) drawn[lane] = gather_moments(f, from, i + lane, stride, totals + lane * stride);
  if (rows < LANES) std::fill(totals + rows * stride, totals + LANES * stride, 0.f);
#if defined(D2_AVX512)
  Floats first[LANES];
  for (int lane = 0; lane < LANES; lane++) first[lane] = Floats::load(totals + lane * stride);
  transpose(first);
  const auto column = [&](int k) { return k < LANES ? first[k] : load_column(totals, stride, k, rows); };
#else
  const auto column = [&](int k) { return load_column(totals, stride, k, rows); };
#endif

  // Only what `project_backward` reads: the rest of a footprint comes from the Gaussian itself.
  Floats offsets[2];
  load_offsets(f, i, rows, offsets);
  const Gaussian<Floats> g = load_gaussians(f, i, rows);
  const Projected<Floats> p = project(g, offsets[0], offsets[1], f.camera, f.constants);
  const Moments<Floats> m = {column(0), column(1), column(2), column(3), column(4), column(5), column(6)};
  Gaussian<Floats> out;
  Floats center[2];
  project_backward(g, p.footprint, m, f.camera, f.constants, out, center[0], center[1]);

  // A Gaussian that was not drawn may hold anything, NaN included.
  const Mask mask = Floats::load(drawn) > Floats(0.f);
  for (int k = 0; k < 3; k++) out.mean[k] = where(mask, out.mean[k]);
  for (int k = 0; k < 6; k++) out.covariance[k] = where(mask, out.covariance[k]);
  for (int k = 0; k < 2; k++) center[k] = where(mask, center[k]);
  store_columns(out.mean, f.grad_means + 3 * i, rows);
  store_columns(out.covariance, f.grad_covariances + 6 * i, rows);
  store_column(where(mask, out.opacity), f.grad_opacities + i, 1, 0, rows);
  if (f.grad_screen_offsets) store_columns(center, f.grad_screen_offsets + 2 * i, rows);
  if (FIXED == 3)
    store_columns({column(7), column(8), column(9)}, f.grad_colors + 3 * i, rows);
  else
    for (int c = 0; c < channels; c++) store_column(column(7 + c), f.grad_colors + i * channels, channels, c, rows);
}

// ---------------------------------------------------------------------------------------------------- survey

// State of a block in the survey: transmittance, that of finished pixels, depth sum, and where the reliability r is
// positive r / (D* + eps), D* r / (D* + eps), r; with FRONT the free space (2).
template <bool FRONT>
static void survey_tile(const Frame& f, int tile, uint8_t* touched, Statistics* statistics) {
  constexpr int fields = FRONT ? 8 : 6;
  float* state = scratch().state.reserve(size_t(BLOCKS) * fields * LANES);
  Unfinished unfinished;
  const Floats infinity = __builtin_inff();
  for_each_block(f, tile, [&](int block, const Patch& patch, auto whole) {
    float* field = state + block * fields * LANES;
    const Floats depth = load_plane<whole>(f.prior_depth, patch), reliability = load_plane<whole>(f.reliability, patch);
    const Mask usable = (reliability > Floats(0.f)) & (reliability < infinity) & (depth > Floats(0.f)) & (depth < infinity);
    const Floats scale = where(usable, Floats(1.f) / (depth + Floats(f.eps)) * reliability);
    untouched<whole>(patch).store(field);
    for (int k = 1; k < 3; k++) Floats(0.f).store(field + k * LANES);
    scale.store(field + 3 * LANES);
    (where(usable, depth) * scale).store(field + 4 * LANES);
    where(usable, reliability).store(field + 5 * LANES);
    if (FRONT) {
      const FreeSpace<Floats> known = free_space(load_plane<whole>(f.near_edge, patch));
      known.near.store(field + 6 * LANES);
      known.scale.store(field + 7 * LANES);
    }
    unfinished.add(block, patch);
  });

  const Corner corner = corner_of(f, tile);
  const Lattice lattice;
  const float log2_alpha_min = f.log2_alpha_min();
  const int32_t begin = f.tiles[tile].begin, pairs = f.tiles[tile].live;
  const uint64_t* keys = sort_by_depth(f.blocks + begin, pairs);
  for_each_reaching(f, keys, pairs, corner, unfinished.blocks, [&](uint32_t id, const Record& r, uint64_t reached) {
    const Spread spread = lattice.spread(r, corner);
    const Floats depth = r.footprint.depth;
    Floats sums[4] = {0.f, 0.f, 0.f, 0.f}, largest_weight = 0.f;  // of Statistics, in its order
    for (uint64_t left = reached; left; left &= left - 1) {
      const int block = __builtin_ctzll(left);
      const Fragment<Floats> here = spread.at(block);
      float* field = state + block * fields * LANES;
      const Floats transmittance = Floats::load(field);
      const Step<Floats> step = composite(here.log2_alpha, transmittance, log2_alpha_min, f.constants);
      unfinished.advance(step, transmittance, block, field + LANES).store(field);
      fma(step.weight, depth, Floats::load(field + 2 * LANES)).store(field + 2 * LANES);
      const Floats scale = Floats::load(field + 3 * LANES), true_depth = Floats::load(field + 4 * LANES);
      const Floats reliability = Floats::load(field + 5 * LANES);
      const Floats error = abs(fma(depth, scale, -true_depth));
      sums[0] = fma(step.weight, reliability, sums[0]);
      sums[1] = fma(step.weight, error, sums[1]);
      sums[2] = sums[2] + where((step.weight > Floats(0.f)) & (reliability > Floats(0.f)), Floats(1.f));
      if (FRONT) sums[3] = fma(step.weight, in_front(load_space(field + 6 * LANES), depth), sums[3]);
      largest_weight = max(step.weight, largest_weight);
    }
    const float most = largest(largest_weight);
    if (!(most > 0.f)) return;
    const int64_t slot = slot_of(f, r, int32_t(id), corner);
    touched[slot] = 1;
    store_quad(sums, &statistics[slot].weight);
    statistics[slot].max_weight = most;
  });

  for_each_block(f, tile, [&](int block, const Patch& patch, auto whole) {
    const float* field = state + block * fields * LANES;
    const Floats transmittance = max(Floats::load(field), Floats::load(field + LANES));
    store_plane<whole>(Floats(1.f) - transmittance, f.alpha, patch);
    store_plane<whole>(Floats::load(field + 2 * LANES), f.depth_sum, patch);
  });
}

static void gather_statistics(const Frame& f, const uint8_t* touched, const Statistics* statistics, int64_t i) {
  float weight = 0, error = 0, front = 0, max_weight = 0;
  int32_t hits = 0;
  for (int64_t slot = f.slots[i]; slot < f.slots[i + 1]; slot++) {
    if (!touched[slot]) continue;
    const Statistics& s = statistics[slot];
    weight += s.weight, error += s.error, front += s.front, hits += int32_t(s.hits);
    max_weight = std::max(max_weight, s.max_weight);
  }
  f.weight[i] = weight, f.error[i] = error, f.front_weight[i] = front, f.max_weight[i] = max_weight, f.hits[i] = hits;
}

// ---------------------------------------------------------------------------------------------------- the calls

static void render(const Frame& f, int64_t pairs) {
  distribute(f, pairs);
  const auto render_any = f.channels == 3 ? (f.near_edge ? render_tile<3, true> : render_tile<3, false>)
                                          : (f.near_edge ? render_tile<0, true> : render_tile<0, false>);
  parallel_for(f.threads, f.tile_count(), [&](int64_t tile) { render_any(f, int(tile)); });
}

static void survey(const Frame& f, int64_t pairs) {
  distribute(f, pairs);
  uint8_t* touched = scratch().touched.reserve(pairs);
  Statistics* statistics = scratch().statistics.reserve(pairs);
  std::fill(touched, touched + pairs, 0);
  const auto survey_any = f.near_edge ? survey_tile<true> : survey_tile<false>;
  parallel_for(f.threads, f.tile_count(), [&](int64_t tile) { survey_any(f, int(tile), touched, statistics); });
  parallel_for(f.threads, f.chunks, [&](int64_t chunk) {
    for (int64_t i = f.chunk_begin(chunk); i < f.chunk_begin(chunk + 1); i++)
      gather_statistics(f, touched, statistics, i);
  });
}

static void backward(const Frame& f, int64_t pairs) {
  const int tiles = f.tile_count();
  const int64_t stride = moment_stride(f.channels);
  const Sums sums = {scratch().touched.reserve(pairs), scratch().moments.reserve(pairs * stride)};
  std::fill(sums.touched, sums.touched + pairs, 0);
  const bool front = f.near_edge && f.grad_front;
  const auto backward_any = f.channels == 3 ? (front ? backward_tile<3, true> : backward_tile<3, false>)
                                            : (front ? backward_tile<0, true> : backward_tile<0, false>);
  parallel_for(f.threads, tiles, [&](int64_t tile) { backward_any(f, int(tile), sums); });
  parallel_for(f.threads, f.chunks, [&](int64_t chunk) {
    float* totals = scratch().state.reserve(size_t(LANES) * stride);
    const int64_t end = f.chunk_begin(chunk + 1);
    int64_t i = f.chunk_begin(chunk);
    const auto group_any = f.channels == 3 ? backward_group<3> : backward_group<0>;
    for (; i < end; i += LANES) group_any(f, sums, i, int(std::min<int64_t>(LANES, end - i)), totals);
  });
}

}  // namespace d2

// ---------------------------------------------------------------------------------------------------- C ABI

// Runs `work`; false where memory does not suffice.
template <class Work>
static bool within_memory(Work work) {
  try {
    work();
    return true;
  } catch (const std::bad_alloc&) {
    return false;
  }
}

// native.py calls `d2_project`, allocates `ids` and `blocks` for as many pairs, and calls one of the next two on the
// same thread; `d2_backward` takes what d2_render left behind. -1 and false mean that memory does not suffice.
extern "C" {
int64_t d2_frame_size() { return sizeof(d2::Frame); }
int32_t d2_tile_count(const d2::Frame* f) { return f->tile_count(); }
int64_t d2_project(const d2::Frame* f) {
  int64_t pairs = -1;
  within_memory([&] { pairs = d2::project_all(*f); });
  return pairs;
}
bool d2_render(const d2::Frame* f, int64_t pairs) {
  return within_memory([&] { d2::render(*f, pairs); });
}
bool d2_survey(const d2::Frame* f, int64_t pairs) {
  return within_memory([&] { d2::survey(*f, pairs); });
}
bool d2_backward(const d2::Frame* f, int64_t pairs) {
  return within_memory([&] { d2::backward(*f, pairs); });
}
}
