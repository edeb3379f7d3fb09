// PatchMatch multi-view stereo on the CPU: one inverse-depth plane per pixel of a reference view.
//
// Planes spread over a red-black checkerboard, each pixel trying the best planes of eight regions around it (ACMH,
// Xu and Tao 2019) and a few random changes; which sources see a pixel is decided jointly from how all candidates match.
// Pixels of one colour read only planes of the other, and random numbers belong to the pixel, so the result does not
// depend on the number of threads.
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <system_error>
#include <thread>
#include <vector>

#include "matching.h"
#include "planes.h"

namespace d2 {

constexpr int kMaxSources = 32;     // one bit each
constexpr int kMaxCandidates = 9;   // the pixel's own plane and one from each region
constexpr int kRowsAtOnce = 4;      // that a thread takes from the queue

extern "C" {

struct Task {
  Picture reference;
  Intrinsics intrinsics;
  int32_t source_count;
  const Source* sources;
  float inverse_far, inverse_near;  // planes outside of this range are not tried
  float contrast;                   // standard deviation of the bilateral weight, grey values in 0..1
  float geometric_weight;           // cost per pixel of forward-backward error; 0 switches the term off
  int32_t rounds;                   // red-black sweeps
  int32_t draw_planes;              // start from random planes instead of those passed in
  int32_t explore;                  // try random depths and normals besides small changes
  int32_t threads;
  uint32_t seed;
  const uint8_t* wanted;  // [H, W]: where it is 0 nothing is matched; null wants all
};

}  // extern "C"

namespace {

// Pixels that a candidate may come from, relative to (0, 0): the one with the lowest cost is taken. All are an odd
// number of steps away, that is of the other colour of the checkerboard.
struct Region {
  int count;
  int dx[11], dy[11];
};

struct Regions {
  Region all[8];

  Regions() {
    for (int side = 0; side < 4; side++) {
      const int x = side == 0 ? -1 : side == 1 ? 1 : 0, y = side == 2 ? -1 : side == 3 ? 1 : 0;
      Region& far = all[2 * side];
      far.count = 0;
      for (int step = 3; step <= 23; step += 2) add(far, x * step, y * step);
      Region& near = all[2 * side + 1];
      near.count = 0;
      add(near, x, y);
      for (int step = 1; step <= 3; step++) {
        for (int across = -step; across <= step; across += 2 * step) {
          add(near, x ? x * (1 + step) : across, y ? y * (1 + step) : across);
        }
      }
    }
  }

  static void add(Region& region, int dx, int dy) {
    region.dx[region.count] = dx;
    region.dy[region.count++] = dy;
  }
};

template <class Work>
void parallel_rows(int rows, int threads, const Work& work) {
  std::atomic<int> next{0};
  const auto run = [&] {
    for (int first; (first = next.fetch_add(kRowsAtOnce)) < rows;) {
      for (int row = first; row < std::min(rows, first + kRowsAtOnce); row++) work(row);
    }
  };
  std::vector<std::thread> others;
  try {
    for (int t = 1; t < threads; t++) others.emplace_back(run);
  } catch (const std::system_error&) {
    // The system grants no more threads: those there are do all rows.
  }
  run();
  for (std::thread& other : others) other.join();
}

// Everything that is known about one reference view while its planes spread.
class Matcher {
 public:
  Matcher(const Task& task, Plane* planes, float* costs, uint32_t* views)
      : task_(task), window_(task.contrast), width_(task.reference.width), height_(task.reference.height),
        planes_(planes), costs_(costs), views_(views) {}

  void initialise_row(int y) {
    for (int x = 0; x < width_; x++) initialise(x, y);
  }

  void update_row(int y, int colour, int round) {
    for (int x = (y + colour) & 1; x < width_; x += 2) update(x, y, round);
  }

 private:
  // Candidates of one pixel and what each costs against each source.
  struct Candidates {
    int count = 0;
    Plane planes[kMaxCandidates];
    float costs[kMaxCandidates][kMaxSources];
  };

  struct Selection {
    float weight[kMaxSources];
    uint32_t views = 0;
  };

  bool wanted(size_t i) const { return !task_.wanted || task_.wanted[i]; }

  void initialise(int x, int y) {
    const size_t i = size_t(y) * width_ + x;
    if (!wanted(i)) {
      costs_[i] = kNoMatch;
      return;
    }
    const Patch patch(window_, task_.reference, x, y);
    if (task_.draw_planes) {
      Random random(task_.seed, uint32_t(i), ~0u);
      const Vector normal = random_normal(task_.intrinsics, x, y, random);
      const float q = random.uniform(task_.inverse_far, task_.inverse_near);
      planes_[i] = plane_through(task_.intrinsics, x, y, q, normal);
    }
    float costs[kMaxSources], sorted[kMaxSources];
    const int count = task_.source_count, half = (count + 1) / 2;
    for (int s = 0; s < count; s++) costs[s] = sorted[s] = match(task_.sources[s], patch, planes_[i], x, y);
    std::sort(sorted, sorted + count);
    float total = 0;
    for (int s = 0; s < half; s++) total += sorted[s];  // the other half may be occluded
    costs_[i] = total / half;
    views_[i] = 0;
    for (int s = 0; s < count; s++) {
      if (costs[s] <= sorted[half - 1] && costs[s] < kNoMatch) views_[i] |= 1u << s;
    }
  }

  void update(int x, int y, int round) {
    const size_t i = size_t(y) * width_ + x;
    if (!wanted(i)) return;
    const Patch patch(window_, task_.reference, x, y);
    if (patch.variance < kMinVariance) {
      costs_[i] = kNoMatch;
      return;
    }
    Candidates candidates = gather(x, y);
    for (int k = 0; k < candidates.count; k++) {
      for (int s = 0; s < task_.source_count; s++) {
        candidates.costs[k][s] = match(task_.sources[s], patch, candidates.planes[k], x, y);
      }
    }
    const Selection selection = select(candidates, x, y, round);
    int best = 0;
    float lowest = 1e9f;
    for (int k = 0; k < candidates.count; k++) {
      const float total = selected_cost(selection, candidates.costs[k], candidates.planes[k], x, y);
      if (total < lowest) lowest = total, best = k;
    }
    planes_[i] = candidates.planes[best];
    costs_[i] = lowest;
    views_[i] = selection.views;
    refine(patch, selection, x, y, round);
  }

  // The pixel's own plane first, then the cheapest plane of each region, none of them twice.
  Candidates gather(int x, int y) const {
    Candidates found;
    found.planes[found.count++] = planes_[size_t(y) * width_ + x];
    for (const Region& region : regions_.all) {
      float lowest = 1e9f;
      const Plane* cheapest = nullptr;
      for (int k = 0; k < region.count; k++) {
        const int column = x + region.dx[k], row = y + region.dy[k];
        if (column < 0 || row < 0 || column >= width_ || row >= height_) continue;
        const size_t j = size_t(row) * width_ + column;
        if (costs_[j] < lowest) lowest = costs_[j], cheapest = &planes_[j];
      }
      if (!cheapest || !in_range(cheapest->inverse_depth(x, y))) continue;
      if (std::find(found.planes, found.planes + found.count, *cheapest) == found.planes + found.count) {
        found.planes[found.count++] = *cheapest;
      }
    }
    return found;
  }

  // Joint view selection (ACMH, section 3.2): a source is weighted by how many candidates match it well, and by whether
  // the neighbours use it; one that most candidates contradict is left out.
  Selection select(const Candidates& candidates, int x, int y, int round) const {
    const float threshold = .8f * std::exp(-float(round * round) / 90.f);
    const float share = candidates.count / 8.f;  // the published counts are for eight candidates
    Selection selection;
    float total = 0;
    for (int s = 0; s < task_.source_count; s++) {
      float likelihood = 0;
      int good = 0, bad = 0;
      for (int k = 0; k < candidates.count; k++) {
        const float cost = candidates.costs[k][s];
        if (cost < threshold) likelihood += std::exp(-cost * cost / .18f), good++;
        if (cost > 1.2f) bad++;
      }
      if (bad >= 3 * share) likelihood = 0;
      else if (good > 2 * share) likelihood /= good;
      else likelihood = std::exp(-threshold * threshold / .32f);
      selection.weight[s] = likelihood * neighbours_use(s, x, y);
      total += selection.weight[s];
    }
    normalise(selection, total);
    return selection;
  }

  float neighbours_use(int source, int x, int y) const {
    float belief = 0;
    const auto ask = [&](int column, int row) {
      if (column < 0 || row < 0 || column >= width_ || row >= height_) return;
      belief += views_[size_t(row) * width_ + column] >> source & 1 ? .9f : .1f;
    };
    ask(x - 1, y), ask(x + 1, y), ask(x, y - 1), ask(x, y + 1);
    return belief;
  }

  // Weights that sum to 1; sources with next to none are dropped, which saves matching them again.
  void normalise(Selection& selection, float total) const {
    float kept = 0;
    for (int s = 0; s < task_.source_count; s++) {
      float& weight = selection.weight[s];
      weight = total > 0 ? weight / total : 1.f / task_.source_count;
      if (weight < 1.f / 30) weight = 0;
      kept += weight;
    }
    for (int s = 0; s < task_.source_count; s++) {
      selection.weight[s] /= kept;
      if (selection.weight[s] > 0) selection.views |= 1u << s;
    }
  }

  float geometric_cost(int source, const Plane& plane, int x, int y) const {
    if (!(task_.geometric_weight > 0)) return 0;
    return task_.geometric_weight * reprojection_error(task_.sources[source], plane, x, y);
  }

  float selected_cost(const Selection& selection, const float* costs, const Plane& plane, int x, int y) const {
    float total = 0;
    for (int s = 0; s < task_.source_count; s++) {
      if (selection.weight[s] > 0) total += selection.weight[s] * (costs[s] + geometric_cost(s, plane, x, y));
    }
    return total;
  }

  // Random planes, and changes that shrink with every round; a trial ends as soon as it costs more than the best.
  void refine(const Patch& patch, const Selection& selection, int x, int y, int round) {
    const size_t i = size_t(y) * width_ + x;
    const Intrinsics& k = task_.intrinsics;
    Random random(task_.seed, uint32_t(i), uint32_t(round));
    float q = planes_[i].inverse_depth(x, y);
    Vector normal = normal_of(k, planes_[i]);
    const auto attempt = [&](float new_q, Vector new_normal) {
      if (!in_range(new_q)) return;
      const Plane plane = plane_through(k, x, y, new_q, new_normal);
      float total = 0;
      for (int s = 0; s < task_.source_count && total < costs_[i]; s++) {
        if (!(selection.weight[s] > 0)) continue;
        const float cost = match(task_.sources[s], patch, plane, x, y) + geometric_cost(s, plane, x, y);
        total += selection.weight[s] * cost;
      }
      if (!(total < costs_[i])) return;
      costs_[i] = total, planes_[i] = plane, q = new_q, normal = new_normal;
    };
    if (task_.explore) {
      const Vector drawn = random_normal(k, x, y, random);
      const float drawn_q = random.uniform(task_.inverse_far, task_.inverse_near);
      attempt(drawn_q, normal), attempt(q, drawn), attempt(drawn_q, drawn);
    }
    const float halved = std::pow(.5f, float(round));
    const float step = std::max(.003f, .04f * halved), turn = std::max(.02f, .3f * halved);
    attempt(q, jittered_normal(k, x, y, normal, turn, random));
    attempt(q * (1 + random.uniform(-step, step)), normal);
    attempt(q * (1 + .25f * random.uniform(-step, step)), jittered_normal(k, x, y, normal, .25f * turn, random));
  }

  bool in_range(float q) const { return q >= task_.inverse_far && q <= task_.inverse_near; }

  const Task& task_;
  const Window window_;
  const Regions regions_;
  const int width_, height_;
  Plane* planes_;
  float* costs_;
  uint32_t* views_;  // bit s: source s was selected
};

// The mean of the neighbours' planes that pass within `tolerance` of the pixel's own inverse depth, weighted by
// similarity of grey value: each neighbour measured the surface with its own window and its own noise.
Plane consensus(const Picture& picture, const Window& window, const Plane* planes, int radius, float tolerance, int x,
                int y) {
  const size_t i = size_t(y) * picture.width + x;
  const float own = planes[i].inverse_depth(x, y);
  const int centre = picture.gray[i];
  float total = 0, a = 0, b = 0, q = 0;
  for (int row = std::max(0, y - radius); row <= std::min(picture.height - 1, y + radius); row++) {
    for (int column = std::max(0, x - radius); column <= std::min(picture.width - 1, x + radius); column++) {
      const size_t j = size_t(row) * picture.width + column;
      const float predicted = planes[j].inverse_depth(x, y);
      const bool agrees = std::abs(predicted - own) < tolerance * own;
      const float weight = agrees ? window.color[std::abs(picture.gray[j] - centre)] : 0.f;
      total += weight, a += weight * planes[j].a, b += weight * planes[j].b, q += weight * predicted;
    }
  }
  if (!(total > 0)) return planes[i];  // only where the pixel's own inverse depth is not positive
  a /= total, b /= total, q /= total;
  return {a, b, q - a * x - b * y};
}

}  // namespace

extern "C" {

// Match one view. planes [H, W, 3] are read unless task.draw_planes, then written; costs [H, W] are written: 1 - NCC in
// 0..2, plus the geometric term where there is one. views [H, W] is zeros, for the sources that each pixel selects.
void d2_patchmatch(const Task* task, float* planes, float* costs, uint32_t* views) {
  Matcher matcher(*task, reinterpret_cast<Plane*>(planes), costs, views);
  const int rows = task->reference.height;
  parallel_rows(rows, task->threads, [&](int y) { matcher.initialise_row(y); });
  for (int round = 0; round < task->rounds; round++) {
    for (int colour = 0; colour < 2; colour++) {
      parallel_rows(rows, task->threads, [&](int y) { matcher.update_row(y, colour, round); });
    }
  }
}

// Average each plane with those of its neighbours that agree; planes and averaged [H, W, 3] must not overlap. Where
// `wanted` [H, W] is 0 the plane stays as it is; null wants all.
void d2_consensus(const Picture* picture, float contrast, int32_t radius, float tolerance, int32_t threads,
                  const uint8_t* wanted, const float* planes, float* averaged) {
  const Window window(contrast);
  const Plane* from = reinterpret_cast<const Plane*>(planes);
  Plane* to = reinterpret_cast<Plane*>(averaged);
  parallel_rows(picture->height, threads, [&](int y) {
    for (int x = 0; x < picture->width; x++) {
      const size_t i = size_t(y) * picture->width + x;
      to[i] = wanted && !wanted[i] ? from[i] : consensus(*picture, window, from, radius, tolerance, x, y);
    }
  });
}

}  // extern "C"

}  // namespace d2
