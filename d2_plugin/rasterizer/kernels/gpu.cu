// Splatting on the GPU: a tile is a block of threads, a warp owns 8 x 4 of its pixels.
//
// Every warp tests 32 Gaussians of the tile at once against its own rectangle of pixels and visits only those that may
// reach alpha_min there. The backward pass walks front to back like the forward pass, peeling what a Gaussian hides off
// the pixel's total, so that nothing is saved per pixel; a warp adds up all values of a Gaussian in one transposed
// reduction, the warps of a tile are added in their order, and every (Gaussian, tile) has a place of its own to write
// to. No float is ever added atomically: the same inputs give the same bits in every run.
//
// No header besides splat.h, so that NVRTC compiles it without a toolkit; tests/rasterizer/cuda_shim.h runs it on the CPU.
// Defined by the host (cuda.py): D2_CHANNELS, colors per Gaussian; D2_FRAME_SIZE, bytes of its Frame.
#include "splat.h"

#define D2_DEVICE __device__ __forceinline__
#define D2_KERNEL extern "C" __global__ void __launch_bounds__(THREADS)

namespace d2 {

constexpr int WARP = 32, THREADS = 256, WARPS = THREADS / WARP;
constexpr int TILE = 16;                              // pixels; TILE of cuda.py
constexpr int SUBTILE_WIDTH = 8, SUBTILE_HEIGHT = 4;  // pixels of a warp
constexpr unsigned ALL_LANES = 0xffffffffu;
constexpr int CHANNELS = D2_CHANNELS;
constexpr int MOMENTS = 7;                 // of struct Moments
constexpr int VALUES = MOMENTS + CHANNELS; // per (Gaussian, tile) in the backward pass
constexpr int STATISTICS = 4;              // weight, error, hits, max_weight; with a near edge also front
constexpr int MAX_WEIGHT = 3;              // which of them is a maximum
constexpr int GATHERERS = 8;               // lanes that add up the tiles of one Gaussian

// A projected Gaussian; 16 numbers, RECORD of native.py.
struct Record {
  Footprint<float> footprint;
  int first_x, first_y, last_x, last_y;  // tiles, inclusive
  int unused[5];
};
static_assert(sizeof(Record) == 64, "two sectors of memory");

// Everything that one call works on; absent pointers are null. A pair is a Gaussian in a tile. The slots of pairs are
// in the order of depth (ties by index) and, for one Gaussian, row-major in its tiles; `ids` and `slots` list the pairs
// sorted by tile, then by slot.
struct Frame {
  Constants constants;
  int width, height, channels, tiles_x;
  float eps;
  long long count, pairs;  // M, P

  const float *T_camera_world, *K;  // [4, 4], [3, 3]
  const float *means, *covariances, *opacities, *colors, *screen_offsets, *background;
  const float *prior_depth, *reliability;  // a pixel counts where both are finite and positive
  const float* near_edge;                  // of the free space; null: there is none

  Record* records;       // [M]
  int* tile_counts;      // [M] tiles of a Gaussian
  float* depths;         // [M] what to sort by
  const int* by_depth;   // [M] Gaussians front to back
  const int* slot_ends;  // [M] by rank of depth: the slot after its last
  int *slot_tiles, *slot_ids;             // [P] by slot
  const int *ids, *slots, *tile_starts;   // [P], [P], [tiles + 1]

  float *color, *depth_sum, *alpha, *front;
  const float *grad_color, *grad_depth_sum, *grad_alpha, *grad_front;
  float* values;  // [P, VALUES] by slot, or [P, STATISTICS (+ 1)]; zero before
  float* moments;  // [M, MOMENTS]
  float *grad_means, *grad_covariances, *grad_opacities, *grad_colors, *grad_screen_offsets;
  float *weight, *error, *max_weight, *front_weight;
  int* hits;
};
static_assert(sizeof(Frame) == D2_FRAME_SIZE, "Frame differs between cuda.py and gpu.cu");

D2_DEVICE long long thread_index() { return (long long)blockIdx.x * THREADS + threadIdx.x; }
D2_DEVICE int lane_index() { return int(threadIdx.x) % WARP; }
D2_DEVICE int warp_index() { return int(threadIdx.x) / WARP; }

// ---------------------------------------------------------------------------------------------------- Gaussians

// Read on the device: the host never waits for the camera.
D2_DEVICE Camera load_camera(const Frame& f) {
  Camera c;
  for (int row = 0; row < 3; row++) {
    for (int column = 0; column < 3; column++) c.rotation[3 * row + column] = f.T_camera_world[4 * row + column];
    c.translation[row] = f.T_camera_world[4 * row + 3];
  }
  c.focal_x = f.K[0], c.center_x = f.K[2], c.focal_y = f.K[4], c.center_y = f.K[5];
  c.width = float(f.width), c.height = float(f.height);
  return c;
}

D2_DEVICE Gaussian<float> load_gaussian(const Frame& f, long long i) {
  Gaussian<float> g;
  for (int k = 0; k < 3; k++) g.mean[k] = f.means[3 * i + k];
  for (int k = 0; k < 6; k++) g.covariance[k] = f.covariances[6 * i + k];
  g.opacity = f.opacities[i];
  return g;
}

D2_DEVICE bool finite_colors(const Frame& f, long long i) {
  float zero = 0.f;
  if (f.colors)
    for (int c = 0; c < f.channels; c++) zero += f.colors[i * f.channels + c] * 0.f;
  return zero >= 0.f;
}

// First and last tile along one axis whose pixel centres lie within `reach` of `center`; none: last < first.
D2_DEVICE void tile_range(float center, float reach, int size, int& first, int& last) {
  const float margin = fma(reach, 1e-5f, 1e-4f);  // rounding of the bound must not cut a fragment
  const float low = max(ceilf(center - reach - margin - 0.5f), 0.f);
  const float high = min(floorf(center + reach + margin - 0.5f), float(size - 1));
  first = 1, last = 0;
  if (low <= high) first = int(low) / TILE, last = int(high) / TILE;
}

// Whether a Gaussian may reach alpha_min at a pixel centre of a rectangle: bounds u and v over it separately.
// dx, dy: from the Gaussian to the middle of the rectangle.
D2_DEVICE bool reaches(const Footprint<float>& f, float dx, float dy, float half_x, float half_y, float log2_alpha_min) {
  const float budget = fma(f.log2_opacity - log2_alpha_min, 1.0001f, 1e-4f);  // generous to rounding
  const float u = max(fabsf(along_u(f, dx, dy)) - fma(f.ux, half_x, fabsf(f.uy) * half_y), 0.f);
  const float v = max(fabsf(along_v(f, dy)) - f.vy * half_y, 0.f);
  return fma(u, u, v * v) <= budget;
}

// Calls call(tile) for the tiles that the ellipse may reach, row-major.
template <class Call>
D2_DEVICE void for_each_tile(const Frame& f, const Record& r, Call call) {
  const float half = 0.5f * (TILE - 1), log2_alpha_min = log2(f.constants.alpha_min);
  for (int y = r.first_y; y <= r.last_y; y++)
    for (int x = r.first_x; x <= r.last_x; x++) {
      const float dx = float(x * TILE) + 0.5f * TILE - r.footprint.x, dy = float(y * TILE) + 0.5f * TILE - r.footprint.y;
      if (reaches(r.footprint, dx, dy, half, half, log2_alpha_min)) call(y * f.tiles_x + x);
    }
}

// Projects Gaussians and counts their tiles: records, tile_counts, depths.
D2_KERNEL d2_project(const Frame f) {
  const long long i = thread_index();
  if (i >= f.count) return;
  const float offset_x = f.screen_offsets ? f.screen_offsets[2 * i] : 0.f;
  const float offset_y = f.screen_offsets ? f.screen_offsets[2 * i + 1] : 0.f;
  const Projected<float> p = project(load_gaussian(f, i), offset_x, offset_y, load_camera(f), f.constants);
  Record r = {p.footprint, 1, 1, 0, 0, {0, 0, 0, 0, 0}};
  int count = 0;
  if (p.visible && finite_colors(f, i)) {
    tile_range(r.footprint.x, p.reach.x, f.width, r.first_x, r.last_x);
    tile_range(r.footprint.y, p.reach.y, f.height, r.first_y, r.last_y);
    for_each_tile(f, r, [&](int) { count++; });
  }
  f.records[i] = r;
  f.tile_counts[i] = count;
  f.depths[i] = count ? r.footprint.depth : 0.f;
}

// Lists the pairs by slot: slot_tiles, slot_ids.
D2_KERNEL d2_list(const Frame f) {
  const long long rank = thread_index();
  if (rank >= f.count) return;
  int slot = rank ? f.slot_ends[rank - 1] : 0;
  if (slot == f.slot_ends[rank]) return;
  const int id = f.by_depth[rank];
  for_each_tile(f, f.records[id], [&](int tile) {
    f.slot_tiles[slot] = tile;
    f.slot_ids[slot++] = id;
  });
}

// ---------------------------------------------------------------------------------------------------- tiles

// The pixel of this thread and the rectangle of its warp.
struct Pixel {
  float x, y;            // pixel centre
  float middle_x, middle_y;  // of the rectangle
  long long index;
  bool inside;           // the image
};

D2_DEVICE Pixel pixel_of_thread(const Frame& f) {
  const int tile = int(blockIdx.x), warp = warp_index(), lane = lane_index(), across = TILE / SUBTILE_WIDTH;
  const int left = tile % f.tiles_x * TILE + warp % across * SUBTILE_WIDTH;
  const int top = tile / f.tiles_x * TILE + warp / across * SUBTILE_HEIGHT;
  const int x = left + lane % SUBTILE_WIDTH, y = top + lane / SUBTILE_WIDTH;
  return {float(x) + 0.5f, float(y) + 0.5f, float(left) + 0.5f * SUBTILE_WIDTH, float(top) + 0.5f * SUBTILE_HEIGHT,
          (long long)y * f.width + x, x < f.width && y < f.height};
}

// Up to SIZE Gaussians of the tile in shared memory, one array per field so that lanes read neighbouring words.
template <int SIZE, bool COLORS>
struct Batch {
  static constexpr int WORDS = SIZE / WARP;                               // masks of 32 Gaussians
  static constexpr int STAGED = COLORS && CHANNELS <= 8 ? CHANNELS : 0;  // more colors are read from where they are
  float field[MOMENTS][SIZE];  // of Footprint, in its order
  float color[STAGED ? STAGED : 1][SIZE];
  int id[SIZE];

  D2_DEVICE void load(const Frame& f, int first, int filled) {
    const int j = int(threadIdx.x);
    if (j >= filled) return;
    id[j] = f.ids[first + j];
    const Footprint<float> p = f.records[id[j]].footprint;
    const float fields[MOMENTS] = {p.x, p.y, p.ux, p.uy, p.vy, p.log2_opacity, p.depth};
    for (int k = 0; k < MOMENTS; k++) field[k][j] = fields[k];
    for (int c = 0; c < STAGED; c++) color[c][j] = f.colors[(long long)id[j] * CHANNELS + c];
  }

  D2_DEVICE Footprint<float> footprint(int j) const {
    return {field[0][j], field[1][j], field[2][j], field[3][j], field[4][j], field[5][j], field[6][j]};
  }

  D2_DEVICE float color_of(const Frame& f, int j, int c) const {
    if constexpr (STAGED > 0)
      return color[c][j];
    else
      return f.colors[(long long)id[j] * CHANNELS + c];
  }

  // Which of the Gaussians 32 word .. 32 word + 31 may reach the warp's rectangle, one bit each.
  D2_DEVICE unsigned reaching(int word, int filled, const Pixel& p, float log2_alpha_min) const {
    const int j = word * WARP + lane_index();
    bool found = false;
    if (j < filled) {
      const Footprint<float> g = footprint(j);
      const float half_x = 0.5f * (SUBTILE_WIDTH - 1), half_y = 0.5f * (SUBTILE_HEIGHT - 1);
      found = reaches(g, p.middle_x - g.x, p.middle_y - g.y, half_x, half_y, log2_alpha_min);
    }
    return __ballot_sync(ALL_LANES, found);
  }
};

// One Gaussian at the pixel of this thread. `transmittance` becomes that behind it: negative where the pixel is
// finished, 0 outside of the image.
struct Visit {
  Fragment<float> fragment;
  Step<float> step;
  float transmittance;  // in front of it
};

D2_DEVICE Visit visit(const Footprint<float>& g, const Pixel& p, float& transmittance, float log2_alpha_min,
                      const Constants& constants) {
  const float dx = p.x - g.x, dy = p.y - g.y;
  Visit v;
  v.fragment = fragment(g.log2_opacity, along_u(g, dx, dy), along_v(g, dy));
  v.transmittance = transmittance;
  v.step = composite(v.fragment.log2_alpha, transmittance, log2_alpha_min, constants);
  transmittance = v.step.transmittance;
  return v;
}

// The free space at the pixel of this thread; none without a near edge and outside of the image.
template <bool FRONT>
D2_DEVICE FreeSpace<float> space_at(const Frame& f, const Pixel& p) {
  return free_space(FRONT && p.inside ? f.near_edge[p.index] : 0.f);
}

D2_DEVICE bool any_open(float transmittance) { return __any_sync(ALL_LANES, transmittance > 0.f); }

// ---------------------------------------------------------------------------------------------------- forward

template <bool FRONT>
D2_DEVICE void render(const Frame& f) {
  using Gaussians = Batch<THREADS, true>;
  __shared__ Gaussians batch;
  const Pixel p = pixel_of_thread(f);
  const float log2_alpha_min = log2(f.constants.alpha_min);
  const int end = f.tile_starts[blockIdx.x + 1];
  const FreeSpace<float> space = space_at<FRONT>(f, p);
  float transmittance = p.inside ? 1.f : 0.f, depth_sum = 0.f, front = 0.f, color[CHANNELS];
  for (int c = 0; c < CHANNELS; c++) color[c] = 0.f;

  for (int first = f.tile_starts[blockIdx.x]; first < end; first += THREADS) {
    if (!__syncthreads_or(transmittance > 0.f)) break;
    const int filled = end - first < THREADS ? end - first : THREADS;
    batch.load(f, first, filled);
    __syncthreads();
    for (int word = 0; word * WARP < filled && any_open(transmittance); word++)
      for (unsigned left = batch.reaching(word, filled, p, log2_alpha_min); left; left &= left - 1) {
        const int j = word * WARP + __ffs(int(left)) - 1;
        const Footprint<float> g = batch.footprint(j);
        const Visit v = visit(g, p, transmittance, log2_alpha_min, f.constants);
        depth_sum = fma(v.step.weight, g.depth, depth_sum);
        if (FRONT) front = fma(v.step.weight, before_edge(space.near, g.depth), front);
        for (int c = 0; c < CHANNELS; c++) color[c] = fma(v.step.weight, batch.color_of(f, j, c), color[c]);
        if (!any_open(transmittance)) break;
      }
  }

  if (!p.inside) return;
  transmittance = fabsf(transmittance);
  f.alpha[p.index] = 1.f - transmittance;
  f.depth_sum[p.index] = depth_sum;
  if (FRONT) f.front[p.index] = front * space.scale;
  for (int c = 0; c < CHANNELS; c++)
    f.color[p.index * CHANNELS + c] = f.background ? fma(transmittance, f.background[c], color[c]) : color[c];
}

D2_KERNEL d2_render(const Frame f) { render<false>(f); }
D2_KERNEL d2_render_front(const Frame f) { render<true>(f); }

// ---------------------------------------------------------------------------------------------------- sums

D2_FN constexpr int power_of_two(int least) {
  int power = 1;
  while (power < least) power *= 2;
  return power;
}

// Halves the values and doubles the lanes that each stands for, until there are no lanes left to add. Templates, since
// every index must be known at compile time: arrays go to memory instead of registers otherwise.
template <int P, int DISTANCE>
D2_DEVICE float fold(const float (&part)[P]) {
  if constexpr (DISTANCE == 0) {
    return part[0];
  } else {
    constexpr int HALF = P > 1 ? P / 2 : 1;
    const bool upper = lane_index() & DISTANCE;
    float sum[HALF];
#pragma unroll
    for (int k = 0; k < HALF; k++) {
      const float low = part[k], high = part[P > 1 ? k + HALF : k];
      sum[k] = (upper ? high : low) + __shfl_xor_sync(ALL_LANES, upper ? low : high, DISTANCE);
    }
    return fold<HALF, DISTANCE / 2>(sum);
  }
}

// Sums of N <= 32 values over the lanes of a warp: lane l returns that of value l / (32 / P), P the power of two from N
// on, after P - 1 + log2(32 / P) shuffles instead of 5 N.
template <int N>
D2_DEVICE float warp_sums(const float (&values)[N]) {
  constexpr int P = power_of_two(N);
  float part[P];
#pragma unroll
  for (int k = 0; k < P; k++) part[k] = k < N ? values[k] : 0.f;
  return fold<P, WARP / 2>(part);
}

// What the warps of a tile found out about the Gaussians of a batch.
template <int SIZE, int N>
struct Shares {
  float value[WARPS][SIZE][N];
  unsigned written[WARPS][SIZE / WARP];

  // Sums over the warp; called by all of its lanes.
  D2_DEVICE void add(int j, const float (&values)[N]) {
    constexpr int lanes = WARP / power_of_two(N);
    const float total = warp_sums(values);
    const int k = lane_index() / lanes;
    if (lane_index() % lanes == 0 && k < N) value[warp_index()][j][k] = total;
  }

  // Adds the shares in the order of warps and writes value k < used of Gaussian j to to(j)[k]; called by all threads of
  // the block. combine(k, total, share).
  template <class To, class Combine>
  D2_DEVICE void flush(int filled, int used, To to, Combine combine) const {
    for (int entry = int(threadIdx.x); entry < filled * N; entry += THREADS) {
      const int j = entry / N, k = entry % N;
      if (k >= used) continue;
      float total = 0.f;
      bool any = false;
      for (int warp = 0; warp < WARPS; warp++)
        if (written[warp][j / WARP] >> (j % WARP) & 1u) total = combine(k, total, value[warp][j][k]), any = true;
      if (any) to(j)[k] = total;
    }
  }
};

// Walks over the pairs of a tile in batches of SIZE: contribute(batch, j, share) is called by whole warps and returns
// whether it put anything into share j; the shares go to rows of `values`, `row` floats long, from `offset` on.
template <int SIZE, bool COLORS, int N, class Contribute, class Combine>
D2_DEVICE void gather_tile(const Frame& f, const Pixel& p, Batch<SIZE, COLORS>& batch, Shares<SIZE, N>& shares,
                           float& transmittance, int row, int offset, Contribute contribute, Combine combine) {
  const float log2_alpha_min = log2(f.constants.alpha_min);
  const int end = f.tile_starts[blockIdx.x + 1];
  for (int first = f.tile_starts[blockIdx.x]; first < end; first += SIZE) {
    if (!__syncthreads_or(transmittance > 0.f)) break;
    const int filled = end - first < SIZE ? end - first : SIZE;
    batch.load(f, first, filled);
    __syncthreads();
    for (int word = 0; word < SIZE / WARP; word++) {
      unsigned written = 0;
      if (word * WARP < filled && any_open(transmittance))
        for (unsigned left = batch.reaching(word, filled, p, log2_alpha_min); left; left &= left - 1) {
          const int bit = __ffs(int(left)) - 1;
          if (contribute(word * WARP + bit)) written |= 1u << bit;
          if (!any_open(transmittance)) break;
        }
      if (lane_index() == 0) shares.written[warp_index()][word] = written;
    }
    __syncthreads();
    const auto to = [&](int j) { return f.values + (long long)f.slots[first + j] * row + offset; };
    shares.flush(filled, row - offset, to, combine);
  }
}

struct Add {
  D2_DEVICE float operator()(int, float total, float share) const { return total + share; }
};

// ---------------------------------------------------------------------------------------------------- backward

// Colors whose gradients are summed together with the moments; the others follow in groups of 32 (one per blockIdx.y).
constexpr int FIRST_COLORS = CHANNELS < WARP - MOMENTS ? CHANNELS : WARP - MOMENTS;
constexpr int BACKWARD_BATCH = MOMENTS + FIRST_COLORS <= 16 ? 64 : 32;  // what shared memory holds

// Where nobody contributes nothing comes back: a loss that divides by alpha sends NaN there, which 0 times a weight would
// not silence.
D2_DEVICE bool receives(const Frame& f, const Pixel& p) { return p.inside && f.alpha[p.index] > 0.f; }

template <bool FRONT>
D2_DEVICE void backward(const Frame& f) {
  constexpr int N = MOMENTS + FIRST_COLORS;
  __shared__ Batch<BACKWARD_BATCH, true> batch;
  __shared__ Shares<BACKWARD_BATCH, N> shares;
  const Pixel p = pixel_of_thread(f);
  const float log2_alpha_min = log2(f.constants.alpha_min), log2_alpha_max = log2(f.constants.alpha_max);
  float transmittance = p.inside ? 1.f : 0.f;

  // dL/d of alpha (with the background's share), depth sum and colors; `space` is scaled by that of the front;
  // `behind` starts as the sum of w dL/dw.
  float on_alpha = 0.f, on_depth = 0.f, behind = 0.f, on_color[CHANNELS];
  for (int c = 0; c < CHANNELS; c++) on_color[c] = 0.f;
  FreeSpace<float> space = {0.f, 0.f};
  if (receives(f, p)) {
    on_alpha = f.grad_alpha ? f.grad_alpha[p.index] : 0.f;
    on_depth = f.grad_depth_sum ? f.grad_depth_sum[p.index] : 0.f;
    behind = fma(on_alpha, f.alpha[p.index], on_depth * f.depth_sum[p.index]);
    if (FRONT) {
      space = space_at<FRONT>(f, p);
      const float on_front = space.scale > 0.f ? f.grad_front[p.index] : 0.f;
      space.scale *= on_front;
      behind = fma(on_front, f.front[p.index], behind);
    }
    for (int c = 0; c < CHANNELS; c++) {
      on_color[c] = f.grad_color ? f.grad_color[p.index * CHANNELS + c] : 0.f;
      // The image holds (1 - A) background, which is part of the dependence on alpha and not of the sum over Gaussians.
      const float background = f.background ? f.background[c] : 0.f;
      behind = fma(on_color[c], f.color[p.index * CHANNELS + c] - background, behind);
      on_alpha = fnma(on_color[c], background, on_alpha);
    }
  }

  const auto contribute = [&](int j) {
    const Footprint<float> g = batch.footprint(j);
    const Visit v = visit(g, p, transmittance, log2_alpha_min, f.constants);
    const float weight = v.step.weight;
    if (!__any_sync(ALL_LANES, weight > 0.f)) return false;
    float value = fma(on_depth, g.depth, on_alpha), on_z = on_depth;
    if (FRONT) {
      value = value + in_front(space, g.depth);
      on_z = on_depth - in_front_gradient(space, g.depth);
    }
    for (int c = 0; c < CHANNELS; c++) value = fma(on_color[c], batch.color_of(f, j, c), value);
    behind = fnma(weight, value, behind);
    const float on_log_alpha =
        log_alpha_gradient(v.step, v.fragment.log2_alpha, v.transmittance, value, behind, log2_alpha_max);
    const float gu = on_log_alpha * v.fragment.u, gv = on_log_alpha * v.fragment.v;
    float sums[N] = {on_log_alpha, gu, gv, gu * v.fragment.u, gu * v.fragment.v, gv * v.fragment.v, weight * on_z};
    for (int c = 0; c < FIRST_COLORS; c++) sums[MOMENTS + c] = weight * on_color[c];
    shares.add(j, sums);
    return true;
  };
  gather_tile(f, p, batch, shares, transmittance, VALUES, 0, contribute, Add());
}

D2_KERNEL d2_backward(const Frame f) { backward<false>(f); }
D2_KERNEL d2_backward_front(const Frame f) { backward<true>(f); }

// Gradients of the colors from FIRST_COLORS on.
D2_KERNEL d2_backward_colors(const Frame f) {
  __shared__ Batch<32, false> batch;
  __shared__ Shares<32, WARP> shares;
  const Pixel p = pixel_of_thread(f);
  const float log2_alpha_min = log2(f.constants.alpha_min);
  float transmittance = p.inside ? 1.f : 0.f;
  const int first = FIRST_COLORS + WARP * int(blockIdx.y);
  float on_color[WARP];
#pragma unroll
  for (int c = 0; c < WARP; c++)
    on_color[c] = f.grad_color && first + c < CHANNELS && receives(f, p) ? f.grad_color[p.index * CHANNELS + first + c] : 0.f;

  const auto contribute = [&](int j) {
    const Visit v = visit(batch.footprint(j), p, transmittance, log2_alpha_min, f.constants);
    if (!__any_sync(ALL_LANES, v.step.weight > 0.f)) return false;
    float sums[WARP];
#pragma unroll
    for (int c = 0; c < WARP; c++) sums[c] = v.step.weight * on_color[c];
    shares.add(j, sums);
    return true;
  };
  gather_tile(f, p, batch, shares, transmittance, VALUES, MOMENTS + first, contribute, Add());
}

// The slots of the Gaussian that this thread and its GATHERERS - 1 neighbours add up.
struct Slots {
  long long rank;
  int begin, end;
};
D2_DEVICE Slots slots_of_thread(const Frame& f) {
  const long long rank = thread_index() / GATHERERS;
  if (rank >= f.count) return {rank, 0, 0};
  return {rank, rank ? f.slot_ends[rank - 1] : 0, f.slot_ends[rank]};
}

// Sum of value k over the slots, in the same order every time; on all of the gatherers.
D2_DEVICE float slot_sum(const Frame& f, const Slots& s, int row, int k) {
  float total = 0.f;
  for (int slot = s.begin + int(threadIdx.x) % GATHERERS; slot < s.end; slot += GATHERERS)
    total += f.values[(long long)slot * row + k];
  for (int distance = GATHERERS / 2; distance > 0; distance /= 2)
    total += __shfl_xor_sync(ALL_LANES, total, distance);
  return total;
}

// Adds up the tiles of a Gaussian: moments and grad_colors.
D2_KERNEL d2_gather(const Frame f) {
  const Slots s = slots_of_thread(f);
  const bool writes = s.rank < f.count && threadIdx.x % GATHERERS == 0;
  const long long id = writes ? f.by_depth[s.rank] : 0;
  for (int k = 0; k < VALUES; k++) {
    const float total = slot_sum(f, s, VALUES, k);
    if (!writes) continue;
    if (k < MOMENTS)
      f.moments[id * MOMENTS + k] = total;
    else
      f.grad_colors[id * CHANNELS + k - MOMENTS] = total;
  }
}

// Gradients of the projection.
D2_KERNEL d2_project_backward(const Frame f) {
  const long long i = thread_index();
  if (i >= f.count) return;
  const float* m = f.moments + i * MOMENTS;
  bool drawn = false;
  for (int k = 0; k < MOMENTS; k++) drawn |= m[k] != 0.f;
  Gaussian<float> out = {{0.f, 0.f, 0.f}, {0.f, 0.f, 0.f, 0.f, 0.f, 0.f}, 0.f};
  float center_x = 0.f, center_y = 0.f;
  // A Gaussian that was not drawn may hold anything, NaN included.
  if (drawn) {
    const Moments<float> moments = {m[0], m[1], m[2], m[3], m[4], m[5], m[6]};
    const Footprint<float> footprint = f.records[i].footprint;
    project_backward(load_gaussian(f, i), footprint, moments, load_camera(f), f.constants, out, center_x, center_y);
  }
  for (int k = 0; k < 3; k++) f.grad_means[3 * i + k] = out.mean[k];
  for (int k = 0; k < 6; k++) f.grad_covariances[6 * i + k] = out.covariance[k];
  f.grad_opacities[i] = out.opacity;
  f.grad_screen_offsets[2 * i] = center_x;
  f.grad_screen_offsets[2 * i + 1] = center_y;
}

// ---------------------------------------------------------------------------------------------------- survey

struct AddOrLargest {
  D2_DEVICE float operator()(int k, float total, float share) const {
    return k == MAX_WEIGHT ? max(total, share) : total + share;
  }
};

template <bool FRONT>
D2_DEVICE void survey(const Frame& f) {
  constexpr int N = STATISTICS + FRONT, SUMS = FRONT ? 4 : 2;
  __shared__ Batch<128, false> batch;
  __shared__ Shares<128, N> shares;
  const Pixel p = pixel_of_thread(f);
  const float log2_alpha_min = log2(f.constants.alpha_min);
  float transmittance = p.inside ? 1.f : 0.f, depth_sum = 0.f;
  const float truth = p.inside ? f.prior_depth[p.index] : 0.f;
  float reliability = p.inside ? f.reliability[p.index] : 0.f;
  const bool counts = truth > 0.f && reliability > 0.f && (truth + reliability) * 0.f == 0.f;
  reliability = where(counts, reliability);
  const float scale = where(counts, 1.f / (truth + f.eps) * reliability), scaled_truth = where(counts, truth * scale);
  const FreeSpace<float> space = space_at<FRONT>(f, p);

  const auto contribute = [&](int j) {
    const Footprint<float> g = batch.footprint(j);
    const float weight = visit(g, p, transmittance, log2_alpha_min, f.constants).step.weight;
    if (!__any_sync(ALL_LANES, weight > 0.f)) return false;
    depth_sum = fma(weight, g.depth, depth_sum);
    const float error = fabsf(fma(g.depth, scale, -scaled_truth));
    float sums[SUMS] = {weight * reliability, weight * error};
    if constexpr (FRONT) sums[2] = weight * in_front(space, g.depth), sums[3] = 0.f;
    const float total = warp_sums(sums);  // value k in the k-th of SUMS groups of lanes
    const int hits = __popc(__ballot_sync(ALL_LANES, counts && weight > 0.f));
    float largest = weight;
    for (int distance = WARP / 2; distance > 0; distance /= 2)
      largest = max(largest, __shfl_xor_sync(ALL_LANES, largest, distance));
    float* share = shares.value[warp_index()][j];
    if (lane_index() == 0) share[0] = total, share[2] = float(hits), share[3] = largest;
    if (lane_index() == WARP / SUMS) share[1] = total;
    if (FRONT && lane_index() == 2 * WARP / SUMS) share[STATISTICS] = total;
    return true;
  };
  gather_tile(f, p, batch, shares, transmittance, N, 0, contribute, AddOrLargest());

  if (!p.inside) return;
  f.alpha[p.index] = 1.f - fabsf(transmittance);
  f.depth_sum[p.index] = depth_sum;
}

D2_KERNEL d2_survey(const Frame f) { survey<false>(f); }
D2_KERNEL d2_survey_front(const Frame f) { survey<true>(f); }

// Adds up the tiles of a Gaussian: weight, error, hits, max_weight, front_weight.
D2_KERNEL d2_gather_survey(const Frame f) {
  const Slots s = slots_of_thread(f);
  const int row = STATISTICS + (f.near_edge ? 1 : 0);
  const float weight = slot_sum(f, s, row, 0), error = slot_sum(f, s, row, 1);
  const float front = f.near_edge ? slot_sum(f, s, row, STATISTICS) : 0.f;
  int hits = 0;
  float largest = 0.f;
  for (int slot = s.begin + int(threadIdx.x) % GATHERERS; slot < s.end; slot += GATHERERS) {
    hits += int(f.values[(long long)slot * row + 2]);
    largest = max(largest, f.values[(long long)slot * row + MAX_WEIGHT]);
  }
  for (int distance = GATHERERS / 2; distance > 0; distance /= 2) {
    hits += __shfl_xor_sync(ALL_LANES, hits, distance);
    largest = max(largest, __shfl_xor_sync(ALL_LANES, largest, distance));
  }
  if (s.rank >= f.count || threadIdx.x % GATHERERS) return;
  const int id = f.by_depth[s.rank];
  f.weight[id] = weight, f.error[id] = error, f.max_weight[id] = largest, f.front_weight[id] = front, f.hits[id] = hits;
}

}  // namespace d2
