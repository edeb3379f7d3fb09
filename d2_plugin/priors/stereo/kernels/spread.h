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
  const unsigned char* gray;        // [H, W] of the reference
  const unsigned char* wanted;      // [H, W]: where it is 0 nothing is matched; null wants all
  const Source* sources;            // [source_count]
  const unsigned* quads;  // of all sources, per pixel its grey value and those right, below and lower right of it
  float* planes;          // [H, W, 3]
  float* costs;           // [H, W]: 1 - NCC in 0..2, of what the planes are worth so far
  unsigned* views;        // [H, W]: bit s says that source s was selected
};

}  // extern "C"

template <class S>
struct Selection {
  S weight[kMaxSources];
  Word<S> views;
};

D2_FN bool wanted(const Task& t, long long i) { return !t.wanted || t.wanted[i]; }
template <class S>
D2_FN Mask<S> in_range(const Task& t, S q) { return (q >= t.inverse_far) & (q <= t.inverse_near); }
D2_FN Plane<float> plane_at(const Task& t, long long i) {
  return {t.planes[3 * i], t.planes[3 * i + 1], t.planes[3 * i + 2]};
}
D2_FN void put(const Task& t, long long i, const Plane<float>& p) {
  t.planes[3 * i] = p.a, t.planes[3 * i + 1] = p.b, t.planes[3 * i + 2] = p.c;
}

// Regions that a candidate may come from: the pixel with the lowest cost is taken. All places are an odd number of steps
// away, that is of the other colour of the checkerboard. Even regions are strips, odd ones a small V; two to a side.
constexpr int kMostPlaces = 11;
D2_FN constexpr int region_size(int region) { return region % 2 ? 7 : kMostPlaces; }
D2_FN constexpr void region_place(int region, int k, int& dx, int& dy) {
  const int side = region / 2, x = side == 0 ? -1 : side == 1 ? 1 : 0, y = side == 2 ? -1 : side == 3 ? 1 : 0;
  const int step = region % 2 ? (k + 1) / 2 : 0, across = k % 2 ? -step : step;
  const int forward = region % 2 ? 1 + step : 3 + 2 * k;
  const bool middle = region % 2 == 0 || k == 0;
  dx = x ? x * forward : middle ? 0 : across;
  dy = y ? y * forward : middle ? 0 : across;
}

// The cheapest pixel of a region, negative where all of it lies outside of the image.
D2_FN int cheapest_of(const Task& t, int x, int y, int region) {
  float lowest = 1e9f;
  int found = -1;
  for (int k = 0; k < region_size(region); k++) {
    int dx, dy;
    region_place(region, k, dx, dy);
    if (x + dx < 0 || y + dy < 0 || x + dx >= t.width || y + dy >= t.height) continue;
    const int j = (y + dy) * t.width + x + dx;
    if (t.costs[j] < lowest) lowest = t.costs[j], found = j;
  }
  return found;
}

template <class S>
D2_FN S belief_of(S cost) { return exp2_of(cost * cost * (-kLog2E / .18f)); }

// The sources that the four neighbours use, and which neighbours there are.
template <class S>
struct Neighbours {
  Word<S> views[4];
  Mask<S> there[4];

  D2_FN Neighbours(const Task& t, Whole<S> x, Whole<S> y, Whole<S> pixel) {
    there[0] = x > 0, there[1] = x + 1 < t.width, there[2] = y > 0, there[3] = y + 1 < t.height;
    const int step[4] = {-1, 1, -t.width, t.width};
    for (int n = 0; n < 4; n++) views[n] = (Word<S>)look_up(t.views, pick(there[n], pixel + step[n], pixel));
  }

  // How far they believe in a source.
  D2_FN S use(int source) const {
    S belief = all<S>(0.f);
    for (int n = 0; n < 4; n++) {
      const S more = pick((Whole<S>)(views[n] >> source & 1u) > 0, all<S>(.9f), all<S>(.1f));
      belief = pick(there[n], belief + more, belief);
    }
    return belief;
  }
};

// Weights that sum to 1; sources with next to none are dropped, but not all: of 30 and more the even share is as small.
template <class S>
D2_FN void normalise(const Task& t, Selection<S>& selection, S total) {
  const S zero = all<S>(0.f), even = all<S>(1.f / float(t.source_count));
  const float least = smaller(1.f / 30, .99f / float(t.source_count));
  S kept = zero;
  for (int s = 0; s < t.source_count; s++) {
    const S share = pick(total > 0.f, selection.weight[s] / total, even);
    selection.weight[s] = pick(share < least, zero, share);
    kept += selection.weight[s];
  }
  selection.views = Word<S>{};
  for (int s = 0; s < t.source_count; s++) {
    selection.weight[s] = selection.weight[s] / kept;
    selection.views |= pick(selection.weight[s] > 0.f, Word<S>{} + (1u << s), Word<S>{});
  }
}

// One pixel in one round, or as many as there are lanes, step by step: each leaves `count` planes, of which those in
// `used` are matched before the next. A step is passed costs(k, s), what plane k costs in source s.
template <class S>
struct Turn {
  const Task& task;
  Whole<S> x, y, pixel;
  int round;
  Sight<S> sight;
  Random<S> random;
  Selection<S> selection;
  Plane<S> best;
  S cost;
  int count;
  Mask<S> used[kMaxCandidates];
  Plane<S> planes[kMaxCandidates];

  D2_FN Turn(const Task& t, Whole<S> column, Whole<S> row, int number)
      : task(t), x(column), y(row), pixel(row * t.width + column), round(number),
        sight(sight_of(t.intrinsics, real(column), real(row))), random(t.seed, (Word<S>)pixel, unsigned(number)),
        cost(all<S>(1e9f)), count(0) {}

  // The pixel's own plane first, then the cheapest plane of each region, none of them twice. cheapest(region) is
  // cheapest_of.
  template <class Cheapest>
  D2_FN void gather(const Cheapest& cheapest) {
    best = plane_from(pixel);
    keep(best, x == x);
    for (int region = 0; region < kRegions; region++) {
      const Whole<S> place = cheapest(region);
      const Mask<S> found = place >= 0;
      const Plane<S> plane = plane_from(pick(found, place, pixel));
      Mask<S> fresh = found & in_range(task, plane.inverse_depth(sight.u, sight.v));
      for (int k = 0; k < count; k++) fresh = fresh & opposite(used[k] & (planes[k] == plane));
      keep(plane, fresh);
    }
  }

  // Joint view selection (ACMH, section 3.2) after gather: a source is weighted by how many candidates match it well,
  // and by whether the neighbours use it; one that most candidates contradict is left out.
  template <class Costs, class Beliefs>
  D2_FN void choose(const Costs& costs, const Beliefs& beliefs) {
    const float threshold = .8f * exp_of(-float(round * round) / 90.f);
    const float faint = exp_of(-threshold * threshold * (1 / .32f));
    const S zero = all<S>(0.f), one = all<S>(1.f);
    S share = zero, total = zero;
    for (int k = 0; k < count; k++) share += pick(used[k], one, zero);
    share = share / 8.f;  // the published counts are for eight candidates
    const Neighbours<S> neighbours(task, x, y, pixel);
    for (int s = 0; s < task.source_count; s++) {
      S likelihood = zero, good = zero, bad = zero;
      for (int k = 0; k < count; k++) {
        const S found = costs(k, s);
        const Mask<S> fits = used[k] & (found < threshold);
        likelihood = pick(fits, likelihood + beliefs(k, s), likelihood);
        good += pick(fits, one, zero);
        bad += pick(used[k] & (found > 1.2f), one, zero);
      }
      likelihood = pick(good > 2.f * share, likelihood / good, all<S>(faint));
      likelihood = pick(bad >= 3.f * share, zero, likelihood);
      selection.weight[s] = likelihood * neighbours.use(s);
      total += selection.weight[s];
    }
    normalise(task, selection, total);
    compare(costs);
  }

  // Keeps the best plane so far, all selected sources together.
  template <class Costs>
  D2_FN void compare(const Costs& costs) {
    for (int k = 0; k < count; k++) {
      S total = all<S>(0.f);
      for (int s = 0; s < task.source_count; s++) {
        const Mask<S> selected = selection.weight[s] > 0.f;
        if (none(selected)) continue;
        total = pick(selected, mad(selection.weight[s], costs(k, s), total), total);
      }
      const Mask<S> better = used[k] & (total < cost);
      cost = pick(better, total, cost), best = pick(better, planes[k], best);
    }
  }

  // Random depths, random normals, both.
  D2_FN void draw_anywhere() {
    count = 0;
    const Vector<S> drawn = random_normal(sight, random);
    const S q = random.uniform(task.inverse_far, task.inverse_near);
    add(q, normal_of(task.intrinsics, best)), add(best.inverse_depth(sight.u, sight.v), drawn), add(q, drawn);
  }

  // Changes that shrink with every round. None builds on another, so that all are matched at once.
  D2_FN void draw_nearby() {
    count = 0;
    const Vector<S> normal = normal_of(task.intrinsics, best);
    const S q = best.inverse_depth(sight.u, sight.v);
    const float halved = bits_float((127 - round) << 23);
    const float step = larger(.04f * halved, .003f), turn = larger(.3f * halved, .02f);
    add(q, jittered_normal(sight, normal, turn, random));
    add(q * (1.f + random.uniform(-step, step)), normal);
    const S finer = .25f * random.uniform(-step, step);
    add(q * (1.f + finer), jittered_normal(sight, normal, .25f * turn, random));
    add(q * (1.f + .1f * random.uniform(-step, step)), normal);
    add(q, jittered_normal(sight, normal, .25f * turn, random));
  }

 private:
  D2_FN Plane<S> plane_from(Whole<S> place) const {
    const int base = first_lane(pixel);  // three times a place may be more than an integer holds
    const float* from = task.planes + 3ll * base;
    const Whole<S> at = (place - base) * 3;
    return {look_up(from, at), look_up(from + 1, at), look_up(from + 2, at)};
  }
  D2_FN void keep(const Plane<S>& plane, Mask<S> yes) { planes[count] = plane, used[count++] = yes; }
  D2_FN void add(S q, const Vector<S>& normal) {
    keep(plane_through(task.intrinsics, sight, q, normal), in_range(task, q));
  }
};

// The plane that a pixel starts with: its own, or a random one where the task says so.
D2_FN Plane<float> drawn_plane(const Task& t, int x, int y) {
  const long long i = (long long)y * t.width + x;
  if (t.draw_planes) {
    Random<float> random(t.seed, unsigned(i), ~0u);
    const Sight<float> sight = sight_of(t.intrinsics, float(x), float(y));
    const Vector<float> normal = random_normal(sight, random);
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
D2_FN Plane<float> mean_plane(const Consensus<float>& sums, float u, float v) {
  const float a = sums.a / sums.total, b = sums.b / sums.total;
  return {a, b, mad(-b, v, mad(-a, u, sums.q / sums.total))};
}

}  // namespace d2
