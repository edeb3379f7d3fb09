// PatchMatch multi-view stereo on the GPU: one thread per pixel does what spread.h says, with the window around it in
// shared memory. The same bits as patchmatch.cpp on a CPU with fused multiply-add.
//
// No header besides ours, so that NVRTC compiles it without a toolkit; tests/rasterizer/cuda_shim.h runs it on the CPU.
// Defined by the host (patchmatch_cuda.py): D2_MAX_SOURCES, sources of a view; D2_CALL_SIZE, bytes of its Call.
#include "spread.h"

#define D2_DEVICE __device__ __forceinline__
#define D2_KERNEL extern "C" __global__ void __launch_bounds__(THREADS)

namespace d2 {

constexpr int THREADS = 64;

// What one launch works on.
struct Call {
  Task task;
  int colour, round, radius;
  float tolerance;
  float* averaged;  // [H, W, 3]
};
static_assert(sizeof(Call) == D2_CALL_SIZE, "Call differs between patchmatch_cuda.py and patchmatch.cu");

// The windows of a block, one array per sample so that threads read neighbouring words.
struct Windows {
  float weight[kSamples][THREADS], weighted[kSamples][THREADS];
};

struct Pixel {
  int x, y;
  bool inside;
};

// The pixel of this thread, of all of them or of those of one colour.
D2_DEVICE Pixel pixel_of_thread(const Task& t, int step, int colour) {
  const long long thread = (long long)blockIdx.x * THREADS + threadIdx.x;
  const int across = (t.width + step - 1) / step, y = int(thread / across);
  const int x = int(thread % across) * step + (step == 2 ? (y + colour) & 1 : 0);
  return {x, y, x < t.width && y < t.height};
}

// The window around one pixel, and its matches.
class Patch {
 public:
  D2_DEVICE Patch(const Task& task, Windows& windows) : task_(task), windows_(windows) {}

  float variance = 0;

  D2_DEVICE void place(int x, int y) {
    const unsigned char* gray = task_.gray + (long long)y * task_.width + x;
    const float centre = gray[0];
    const int me = int(threadIdx.x);
    float level[kSamples], total[kPartials], mean[kPartials], squares[kPartials];
#pragma unroll
    for (int l = 0; l < kPartials; l++) total[l] = mean[l] = squares[l] = 0;
#pragma unroll
    for (int n = 0; n < kSamples; n++) {
      const int du = sample_du(n), dv = sample_dv(n);
      const bool inside = x + du >= 0 && y + dv >= 0 && x + du < task_.width && y + dv < task_.height;
      level[n] = inside ? float(gray[(long long)dv * task_.width + du]) : centre;
      const float off = level[n] - centre, log2_weight = mad(off * off, task_.per_gray, log2_spatial(du, dv));
      const float w = (inside ? 1.f : 0.f) * exp2_of(log2_weight);
      windows_.weight[n][me] = w;
      total[n % kPartials] += w, mean[n % kPartials] = mad(w, level[n], mean[n % kPartials]);
    }
    const float scale = 1.f / sum_of_partials(total), middle = sum_of_partials(mean) * scale;
#pragma unroll
    for (int n = 0; n < kSamples; n++) {
      const float w = windows_.weight[n][me] * scale, off = level[n] - middle, weighted = w * off;
      windows_.weight[n][me] = w, windows_.weighted[n][me] = weighted;
      squares[n % kPartials] = mad(weighted, off, squares[n % kPartials]);
    }
    u_ = float(x), v_ = float(y), variance = sum_of_partials(squares);
  }

  // Costs [count, source_count] of the planes that are used; those of sources whose bit in `views` is 0 stay as they
  // are.
  D2_DEVICE void match(const Plane<float>* planes, const bool* used, int count, unsigned views, float* costs) const {
    for (int s = 0; s < task_.source_count; s++) {
      if (!(views >> s & 1)) continue;
      for (int p = 0; p < count; p++)
        if (used[p]) costs[p * task_.source_count + s] = cost(planes[p], task_.sources[s]);
    }
  }

 private:
  D2_DEVICE float cost(const Plane<float>& plane, const Source& source) const {
    const float width = float(source.width), height = float(source.height);
    const Warp<float> warp = warp_of(source.A, source.k, width, height, plane.a, plane.b, plane.c, u_, v_);
    const float last_x = last_place(source.width), last_y = last_place(source.height);
    const int me = int(threadIdx.x);
    Sums<float> sums = {0, 0, 0};
#pragma unroll 8
    for (int n = 0; n < kSamples; n++)
      sums.add<false>(task_.quads, source.first, source.width, last_x, last_y, warp, line_of(warp, float(sample_dv(n))),
                      float(sample_du(n)), windows_.weight[n][me], windows_.weighted[n][me]);
    return sums.cost(variance, warp.seen);
  }

  const Task& task_;
  Windows& windows_;
  float u_ = 0, v_ = 0;
};

// The start of every pixel: its plane, what it costs and who sees it.
D2_KERNEL d2_patchmatch_begin(const Call call) {
  __shared__ Windows windows;
  const Task& t = call.task;
  const Pixel p = pixel_of_thread(t, 1, 0);
  const long long i = (long long)p.y * t.width + p.x;
  if (!p.inside || !wanted(t, i)) return;
  Patch patch(t, windows);
  patch.place(p.x, p.y);
  const Plane<float> plane = drawn_plane(t, p.x, p.y);
  const bool used = true;
  float costs[kMaxSources];
  patch.match(&plane, &used, 1, ~0u, costs);
  begin(t, costs, i);
}

// What one pixel does in one round; `patch` lies around it.
D2_DEVICE void update(const Task& t, const Patch& patch, int x, int y, int round) {
  float costs[kMaxCandidates * kMaxSources];
  const auto cost = [&](int k, int s) { return costs[k * t.source_count + s]; };
  Turn<float> turn(t, x, y, round);
  turn.gather([&](int region) { return cheapest_of(t, x, y, region); });
  patch.match(turn.planes, turn.used, turn.count, ~0u, costs);
  turn.choose(cost, [&](int k, int s) { return belief_of(cost(k, s)); });
  if (t.explore) {
    turn.draw_anywhere();
    patch.match(turn.planes, turn.used, turn.count, turn.selection.views, costs);
    turn.compare(cost);
  }
  turn.draw_nearby();
  patch.match(turn.planes, turn.used, turn.count, turn.selection.views, costs);
  turn.compare(cost);
  const long long i = (long long)y * t.width + x;
  put(t, i, turn.best);
  t.costs[i] = turn.cost, t.views[i] = turn.selection.views;
}

// Half a round: the pixels of one colour.
D2_KERNEL d2_patchmatch_update(const Call call) {
  __shared__ Windows windows;
  const Task& t = call.task;
  const Pixel p = pixel_of_thread(t, 2, call.colour);
  const long long i = (long long)p.y * t.width + p.x;
  if (!p.inside || !wanted(t, i)) return;
  Patch patch(t, windows);
  patch.place(p.x, p.y);
  if (patch.variance < kMinVariance) t.costs[i] = kNoMatch;
  else update(t, patch, p.x, p.y, call.round);
}

// Averages each plane with those of its neighbours that agree.
D2_KERNEL d2_patchmatch_average(const Call call) {
  const Task& t = call.task;
  const Pixel p = pixel_of_thread(t, 1, 0);
  if (!p.inside) return;
  const long long i = (long long)p.y * t.width + p.x;
  const Plane<float> plane = plane_at(t, i);
  const float u = float(p.x), v = float(p.y), own = plane.inverse_depth(u, v), level = t.gray[i];
  Consensus<float> sums = {0, 0, 0, 0};
  if (wanted(t, i)) {
    for (int y = p.y - call.radius; y <= p.y + call.radius; y++) {
      for (int x = p.x - call.radius; x <= p.x + call.radius; x++) {
        if (x < 0 || y < 0 || x >= t.width || y >= t.height) continue;
        const long long j = (long long)y * t.width + x;
        const Plane<float> other = plane_at(t, j);
        sums.add(own, call.tolerance, float(t.gray[j]) - level, t.per_gray, other.a, other.b, other.inverse_depth(u, v));
      }
    }
  }
  const Plane<float> mean = sums.total > 0 ? mean_plane(sums, u, v) : plane;
  call.averaged[3 * i] = mean.a, call.averaged[3 * i + 1] = mean.b, call.averaged[3 * i + 2] = mean.c;
}

}  // namespace d2
