// How planes spread over a reference view: what one pixel does in one round.
//
// Planes spread over a red-black checkerboard, each pixel trying the best planes of eight regions around it (ACMH,
// Xu and Tao 2019) and a few random changes; which sources see a pixel is decided jointly from how all candidates match.
// Pixels of one colour read only planes of the other, and random numbers belong to the pixel, so the result depends
// neither on the number of threads nor on the device.
#pragma once

#include "matching.h"

namespace d2 {

#if defined(D2_MAX_SOURCES)
constexpr int kMaxSources = D2_MAX_SOURCES;
#else
constexpr int kMaxSources = 32;    // one bit each
#endif
constexpr int kMaxCandidates = 9;  // the pixel's own plane and one from each region
constexpr int kRegions = 8;

extern "C" {

// Everything that the planes of one reference view spread by.
struct Task {
  Intrinsics intrinsics;
  int width, height;
  int source_count;
  int rounds;                       // red-black sweeps
  int draw_planes;                  // start from random planes instead of those passed in
  int explore;                      // try random depths and normals besides small changes
  int threads;                      // on the CPU
  unsigned seed;
  float inverse_far, inverse_near;  // planes outside of this range are not tried
  float per_gray;                   // see sample_weight
  float geometric_weight;           // cost per pixel of forward-backward error; 0 switches the term off
  const unsigned char* gray;        // [H, W] of the reference
  const unsigned char* wanted;      // [H, W]: where it is 0 nothing is matched; null wants all
  const Source* sources;            // [source_count]
  const unsigned* quads;  // of all sources, per pixel its grey value and those right, below and lower right of it
  const float* depths;    // of all sources, or null where no geometric term is wanted
  float* planes;          // [H, W, 3]
  float* costs;           // [H, W]: 1 - NCC in 0..2 plus the geometric term, of what the planes are worth so far
  unsigned* views;        // [H, W]: bit s says that source s was selected
};

}  // extern "C"

struct Selection {
  float weight[kMaxSources];
  unsigned views;
};

D2_FN bool wanted(const Task& t, long long i) { return !t.wanted || t.wanted[i]; }
D2_FN bool in_range(const Task& t, float q) { return q >= t.inverse_far && q <= t.inverse_near; }
D2_FN Plane plane_at(const Task& t, long long i) { return {t.planes[3 * i], t.planes[3 * i + 1], t.planes[3 * i + 2]}; }
D2_FN void put(const Task& t, long long i, const Plane& p) {
  t.planes[3 * i] = p.a, t.planes[3 * i + 1] = p.b, t.planes[3 * i + 2] = p.c;
}

// Regions that a candidate may come from: the pixel with the lowest cost is taken. All places are an odd number of steps
// away, that is of the other colour of the checkerboard. Even regions are strips, odd ones a small V; two to a side.
constexpr int kFarthest = 23, kMostPlaces = 11;
D2_FN int region_size(int region) { return region % 2 ? 7 : kMostPlaces; }
D2_FN void region_place(int region, int k, int& dx, int& dy) {
  const int side = region / 2, x = side == 0 ? -1 : side == 1 ? 1 : 0, y = side == 2 ? -1 : side == 3 ? 1 : 0;
  const int step = region % 2 ? (k + 1) / 2 : 0, across = k % 2 ? -step : step;
  const int forward = region % 2 ? 1 + step : 3 + 2 * k;
  const bool middle = region % 2 == 0 || k == 0;
  dx = x ? x * forward : middle ? 0 : across;
  dy = y ? y * forward : middle ? 0 : across;
}

// The cheapest pixel of a region, negative where all of it lies outside of the picture.
D2_FN long long cheapest_of(const Task& t, int x, int y, int region) {
  const long long i = (long long)y * t.width + x;
  float lowest = 1e9f;
  long long found = -1;
  for (int k = 0; k < region_size(region); k++) {
    int dx, dy;
    region_place(region, k, dx, dy);
    if (x + dx < 0 || y + dy < 0 || x + dx >= t.width || y + dy >= t.height) continue;
    const long long j = i + (long long)dy * t.width + dx;
    if (t.costs[j] < lowest) lowest = t.costs[j], found = j;
  }
  return found;
}

template <class S>
D2_FN S belief_of(S cost) { return exp2_of(cost * cost * (-kLog2E / .18f)); }

// How far the four neighbours believe in a source.
D2_FN float neighbours_use(const Task& t, int source, int x, int y) {
  const long long i = (long long)y * t.width + x;
  float belief = 0;
  if (x > 0) belief += t.views[i - 1] >> source & 1 ? .9f : .1f;
  if (x + 1 < t.width) belief += t.views[i + 1] >> source & 1 ? .9f : .1f;
  if (y > 0) belief += t.views[i - t.width] >> source & 1 ? .9f : .1f;
  if (y + 1 < t.height) belief += t.views[i + t.width] >> source & 1 ? .9f : .1f;
  return belief;
}

// Weights that sum to 1; sources with next to none are dropped.
D2_FN void normalise(const Task& t, Selection& selection, float total) {
  float kept = 0;
  for (int s = 0; s < t.source_count; s++) {
    const float share = total > 0 ? selection.weight[s] / total : 1.f / float(t.source_count);
    selection.weight[s] = share < 1.f / 30 ? 0.f : share;
    kept += selection.weight[s];
  }
  selection.views = 0;
  for (int s = 0; s < t.source_count; s++) {
    selection.weight[s] /= kept;
    if (selection.weight[s] > 0) selection.views |= 1u << s;
  }
}

// Joint view selection (ACMH, section 3.2): a source is weighted by how many candidates match it well, and by whether
// the neighbours use it; one that most candidates contradict is left out. costs [count, source_count], and belief
// exp(-cost^2 / .18) of each.
D2_FN Selection select_views(const Task& t, const float* costs, const float* belief, int count, int x, int y, int round) {
  const float threshold = .8f * exp_of(-float(round * round) / 90.f);
  const float faint = exp_of(-threshold * threshold * (1 / .32f));
  const float share = count / 8.f;  // the published counts are for eight candidates
  Selection selection;
  float total = 0;
  for (int s = 0; s < t.source_count; s++) {
    float likelihood = 0;
    int good = 0, bad = 0;
    for (int k = 0; k < count; k++) {
      const float cost = costs[k * t.source_count + s];
      if (cost < threshold) likelihood += belief[k * t.source_count + s], good++;
      if (cost > 1.2f) bad++;
    }
    if (bad >= 3 * share) likelihood = 0;
    else if (good > 2 * share) likelihood /= good;
    else likelihood = faint;
    selection.weight[s] = likelihood * neighbours_use(t, s, x, y);
    total += selection.weight[s];
  }
  normalise(t, selection, total);
  return selection;
}

// What a plane costs, all selected sources together.
D2_FN float total_cost(const Task& t, const Selection& selection, const float* costs, const Plane& plane, int x, int y) {
  float total = 0;
  for (int s = 0; s < t.source_count; s++) {
    if (!(selection.weight[s] > 0)) continue;
    float cost = costs[s];
    if (t.geometric_weight > 0)
      cost = mad(t.geometric_weight, reprojection_error(t.sources[s], t.depths, plane, float(x), float(y)), cost);
    total = mad(selection.weight[s], cost, total);
  }
  return total;
}

// One pixel in one round, step by step: each leaves `count` planes that the device matches before the next.
struct Turn {
  const Task& task;
  int x, y, round;
  Sight sight;
  Random random;
  Selection selection;
  Plane best;
  float cost;
  int count;
  Plane planes[kMaxCandidates];

  D2_FN Turn(const Task& t, int column, int row, int number)
      : task(t), x(column), y(row), round(number), sight(sight_of(t.intrinsics, float(column), float(row))),
        random(t.seed, unsigned(pixel()), unsigned(number)), cost(1e9f), count(0) {}

  D2_FN long long pixel() const { return (long long)y * task.width + x; }

  // The pixel's own plane first, then the cheapest plane of each region, none of them twice. cheapest(region) is
  // cheapest_of.
  template <class Cheapest>
  D2_FN void gather(const Cheapest& cheapest) {
    planes[count++] = best = plane_at(task, pixel());
    for (int region = 0; region < kRegions; region++) {
      const long long place = cheapest(region);
      if (place < 0) continue;
      const Plane plane = plane_at(task, place);
      bool fresh = in_range(task, plane.inverse_depth(sight.u, sight.v));
      for (int k = 0; k < count; k++) fresh = fresh && !(planes[k] == plane);
      if (fresh) planes[count++] = plane;
    }
  }

  // Keeps the best plane so far. costs [count, source_count], of the selected sources.
  D2_FN void compare(const float* costs) {
    for (int k = 0; k < count; k++) {
      const float total = total_cost(task, selection, costs + k * task.source_count, planes[k], x, y);
      if (total < cost) cost = total, best = planes[k];
    }
  }

  // After gather: which sources count, and the best of what was gathered. See select_views.
  D2_FN void choose(const float* costs, const float* belief) {
    selection = select_views(task, costs, belief, count, x, y, round);
    compare(costs);
  }

  // Random depths, random normals, both.
  D2_FN void draw_anywhere() {
    count = 0;
    const Vector drawn = random_normal(sight, random);
    const float q = random.uniform(task.inverse_far, task.inverse_near);
    add(q, normal_of(task.intrinsics, best)), add(best.inverse_depth(sight.u, sight.v), drawn), add(q, drawn);
  }

  // Changes that shrink with every round. None builds on another, so that all are matched at once.
  D2_FN void draw_nearby() {
    count = 0;
    const Vector normal = normal_of(task.intrinsics, best);
    const float q = best.inverse_depth(sight.u, sight.v), halved = bits_float((127 - round) << 23);
    const float step = larger(.04f * halved, .003f), turn = larger(.3f * halved, .02f);
    add(q, jittered_normal(sight, normal, turn, random));
    add(q * (1 + random.uniform(-step, step)), normal);
    const float finer = .25f * random.uniform(-step, step);
    add(q * (1 + finer), jittered_normal(sight, normal, .25f * turn, random));
    add(q * (1 + .1f * random.uniform(-step, step)), normal);
    add(q, jittered_normal(sight, normal, .25f * turn, random));
  }

  D2_FN void finish() const {
    put(task, pixel(), best);
    task.costs[pixel()] = cost;
    task.views[pixel()] = selection.views;
  }

 private:
  D2_FN void add(float q, Vector normal) {
    if (in_range(task, q)) planes[count++] = plane_through(task.intrinsics, sight, q, normal);
  }
};

// The plane that a pixel starts with: its own, or a random one where the task says so.
D2_FN Plane drawn_plane(const Task& t, int x, int y) {
  const long long i = (long long)y * t.width + x;
  if (t.draw_planes) {
    Random random(t.seed, unsigned(i), ~0u);
    const Sight sight = sight_of(t.intrinsics, float(x), float(y));
    const Vector normal = random_normal(sight, random);
    put(t, i, plane_through(t.intrinsics, sight, random.uniform(t.inverse_far, t.inverse_near), normal));
  }
  return plane_at(t, i);
}

// The start of a pixel: what its plane costs in the better half of the sources. costs [source_count].
D2_FN void begin(const Task& t, const float* costs, long long i) {
  unsigned chosen = 0, views = 0;
  float total = 0;
  const int half = (t.source_count + 1) / 2;  // the others may be occluded
  for (int n = 0; n < half; n++) {
    int best = -1;
    for (int s = 0; s < t.source_count; s++)
      if (!(chosen >> s & 1) && (best < 0 || costs[s] < costs[best])) best = s;
    chosen |= 1u << best;
    if (costs[best] < kNoMatch) views |= 1u << best;
    total += costs[best];
  }
  t.costs[i] = total / half;
  t.views[i] = views;
}

// The mean of the neighbours' planes that pass within `tolerance` of the pixel's own inverse depth, weighted by
// similarity of grey value: each neighbour measured the surface with its own window and its own noise.
template <class S>
struct Consensus {
  S total, a, b, q;

  D2_FN void add(S own, float tolerance, S difference, float per_gray, S their_a, S their_b, S predicted) {
    const S off = predicted - own, allowed = tolerance * own;
    const S weight = pick((off < allowed) & (-off < allowed), exp2_of(difference * difference * per_gray), all<S>(0.f));
    total += weight;
    a = mad(weight, their_a, a), b = mad(weight, their_b, b), q = mad(weight, predicted, q);
  }
};

// Where the total is positive.
D2_FN Plane mean_plane(const Consensus<float>& sums, float u, float v) {
  const float a = sums.a / sums.total, b = sums.b / sums.total;
  return {a, b, mad(-b, v, mad(-a, u, sums.q / sums.total))};
}

}  // namespace d2
