// PatchMatch multi-view stereo on the CPU: the pixels of spread.h in threads, and the matches of one pixel (candidates
// times sources) in the lanes of vectors, so that no sum runs across a vector.
#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <system_error>
#include <thread>
#include <vector>

#include "lanes.h"  // before spread.h: templates find what is declared before them
#include "spread.h"

namespace d2 {
namespace {

constexpr int kRowsAtOnce = 4;  // that a thread takes from the queue
constexpr int kMostMatches = (kMaxCandidates * kMaxSources + 15) / 16 * 16;

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

// What the lanes need of the sources: match n is of plane n / sources with source n % sources.
struct Table {
  alignas(64) float A[9][kMostMatches], k[3][kMostMatches];
  alignas(64) float width[kMostMatches], height[kMostMatches], last_x[kMostMatches], last_y[kMostMatches];
  alignas(64) int first[kMostMatches], stride[kMostMatches];
  alignas(64) float du[kSamples], dv[kSamples], log2_weight[kSamples];
  ptrdiff_t offset[kSamples];                     // of the samples, in pixels
  ptrdiff_t neighbour[kRegions][kMostPlaces];  // of the places of a region

  explicit Table(const Task& t) {
    for (int n = 0; n < kMostMatches; n++) {
      const Source& source = t.sources[n % t.source_count];
      for (int e = 0; e < 9; e++) A[e][n] = source.A[e];
      for (int e = 0; e < 3; e++) k[e][n] = source.k[e];
      width[n] = float(source.width), height[n] = float(source.height);
      last_x[n] = last_place(source.width), last_y[n] = last_place(source.height);
      first[n] = source.first, stride[n] = source.width;
    }
    for (int n = 0; n < kSamples; n++) {
      du[n] = float(sample_du(n)), dv[n] = float(sample_dv(n));
      log2_weight[n] = log2_spatial(sample_du(n), sample_dv(n));
      offset[n] = ptrdiff_t(sample_dv(n)) * t.width + sample_du(n);
    }
    for (int region = 0; region < kRegions; region++) {
      for (int n = 0; n < region_size(region); n++) {
        int dx, dy;
        region_place(region, n, dx, dy);
        neighbour[region][n] = ptrdiff_t(dy) * t.width + dx;
      }
    }
  }
};

// The costs of kLanes matches from number `from` of the table on. weight(n) and weighted(n) are those of sample n.
template <class Weight, class Weighted>
D2_FN Floats match_lanes(const Task& task, const Table& t, int from, Floats a, Floats b, Floats c, Floats u, Floats v,
                         Floats variance, const Weight& weight, const Weighted& weighted) {
  Floats A[9], k[3];
  for (int e = 0; e < 9; e++) A[e] = load<Floats>(t.A[e] + from);
  for (int e = 0; e < 3; e++) k[e] = load<Floats>(t.k[e] + from);
  const Floats width = load<Floats>(t.width + from), height = load<Floats>(t.height + from);
  const Warp<Floats> warp = warp_of(A, k, width, height, a, b, c, u, v);
  const Floats last_x = load<Floats>(t.last_x + from), last_y = load<Floats>(t.last_y + from);
  const Integers first = load<Integers>(t.first + from), stride = load<Integers>(t.stride + from);
  Sums<Floats> sums = {};
  for (int n = 0; n < kSamples; n++) {
    const Floats du = all<Floats>(t.du[n]), dv = all<Floats>(t.dv[n]);
    sums.add(task.quads, first, stride, last_x, last_y, warp, du, dv, weight(n), weighted(n));
  }
  return sums.cost(variance, warp.seen);
}

// The window around one pixel, and its matches.
class Patch {
 public:
  Patch(const Task& task, const Table& table) : task_(task), table_(table) {}

  float variance = 0;

  void place(int x, int y) {
    alignas(64) float value[kSamples], inside[kSamples];
    const float centre = read(x, y, value, inside);
    alignas(64) float total[kPartials], mean[kPartials], squares[kPartials];
    for (int l = 0; l < kPartials; l += kLanes) {
      Floats sum = {}, sum_mean = {};
      for (int n = l; n < kSamples; n += kPartials) {
        const Floats level = load<Floats>(value + n), off = level - centre;
        const Floats log2_weight = mad(off * off, all<Floats>(task_.per_gray), load<Floats>(table_.log2_weight + n));
        const Floats w = load<Floats>(inside + n) * exp2_of(log2_weight);
        store(weight_ + n, w);
        sum += w, sum_mean = mad(w, level, sum_mean);
      }
      store(total + l, sum), store(mean + l, sum_mean);
    }
    const float scale = 1.f / sum_of_partials(total), middle = sum_of_partials(mean) * scale;
    for (int l = 0; l < kPartials; l += kLanes) {
      Floats sum = {};
      for (int n = l; n < kSamples; n += kPartials) {
        const Floats w = load<Floats>(weight_ + n) * scale, off = load<Floats>(value + n) - middle, weighted = w * off;
        store(weight_ + n, w), store(weighted_ + n, weighted);
        sum = mad(weighted, off, sum);
      }
      store(squares + l, sum);
    }
    u_ = float(x), v_ = float(y), variance = sum_of_partials(squares);
  }

  // Costs [count, source_count] of planes.
  void match(const Plane* planes, int count, float* costs) const {
    const int sources = task_.source_count, matches = count * sources;
    alignas(64) float a[kMostMatches], b[kMostMatches], c[kMostMatches];
    int n = 0;
    for (int p = 0; p < count; p++) {
      for (int s = 0; s < sources; s++, n++) a[n] = planes[p].a, b[n] = planes[p].b, c[n] = planes[p].c;
    }
    for (; n % kLanes; n++) a[n] = b[n] = c[n] = 0;
    const Floats u = all<Floats>(u_), v = all<Floats>(v_);
    const auto weight = [&](int k) { return all<Floats>(weight_[k]); };
    const auto weighted = [&](int k) { return all<Floats>(weighted_[k]); };
    alignas(64) float found[kLanes];
    for (int from = 0; from < matches; from += kLanes) {
      const Floats planes_a = load<Floats>(a + from), planes_b = load<Floats>(b + from), planes_c = load<Floats>(c + from);
      const Floats reference = all<Floats>(variance);
      store(found, match_lanes(task_, table_, from, planes_a, planes_b, planes_c, u, v, reference, weight, weighted));
      std::copy_n(found, std::min(kLanes, matches - from), costs + from);
    }
  }

  float weight(int n) const { return weight_[n]; }
  float weighted(int n) const { return weighted_[n]; }

  void believe(const float* costs, int count, float* beliefs) const {
    alignas(64) float part[kLanes] = {};
    for (int from = 0; from < count; from += kLanes) {
      std::copy_n(costs + from, std::min(kLanes, count - from), part);
      store(part, belief_of(load<Floats>(part)));
      std::copy_n(part, std::min(kLanes, count - from), beliefs + from);
    }
  }

  // cheapest_of, without looking for the border where that is far.
  long long cheapest(int x, int y, int region) const {
    const bool inner = std::min(x, y) >= kFarthest && x + kFarthest < task_.width && y + kFarthest < task_.height;
    if (!inner) return cheapest_of(task_, x, y, region);
    const float* costs = task_.costs + size_t(y) * task_.width + x;
    float lowest = 1e9f;
    ptrdiff_t found = 0;
    for (int n = 0; n < region_size(region); n++) {
      const ptrdiff_t place = table_.neighbour[region][n];
      if (costs[place] < lowest) lowest = costs[place], found = place;
    }
    return found ? costs + found - task_.costs : -1;
  }

 private:
  // Grey values of the window and 1 where there is a pixel, 0 outside of the picture; that of the middle.
  float read(int x, int y, float* value, float* inside) const {
    const uint8_t* gray = task_.gray + size_t(y) * task_.width + x;
    if (x >= 5 && y >= 5 && x + 5 < task_.width && y + 5 < task_.height) {
      for (int n = 0; n < kSamples; n++) value[n] = gray[table_.offset[n]], inside[n] = 1;
      return *gray;
    }
    for (int n = 0; n < kSamples; n++) {
      const int column = x + sample_du(n), row = y + sample_dv(n);
      inside[n] = column >= 0 && row >= 0 && column < task_.width && row < task_.height;
      value[n] = inside[n] > 0 ? gray[table_.offset[n]] : *gray;
    }
    return *gray;
  }

  const Task& task_;
  const Table& table_;
  float u_ = 0, v_ = 0;
  alignas(64) float weight_[kSamples], weighted_[kSamples];
};

// Windows of several pixels and their own planes, against as many sources as there are lanes: at the start each pixel has
// few matches.
class Pack {
 public:
  Pack(const Task& task, const Table& table) : task_(task), table_(table), patch_(task, table) {}

  // For begin: the plane of the pixel that was given last waits until the lanes are full.
  void add(int x, int y) {
    patch_.place(x, y);
    const Plane plane = drawn_plane(task_, x, y);
    for (int s = 0; s < task_.source_count; s++) {
      const int lane = count_++;
      a_[lane] = plane.a, b_[lane] = plane.b, c_[lane] = plane.c;
      u_[lane] = float(x), v_[lane] = float(y), variance_[lane] = patch_.variance;
      for (int n = 0; n < kSamples; n++) weight_[n][lane] = patch_.weight(n), weighted_[n][lane] = patch_.weighted(n);
    }
    places_[waiting_++] = size_t(y) * task_.width + x;
    if (count_ + task_.source_count > kPacked) flush();
  }

  void flush() {
    for (int lane = count_; lane % kLanes; lane++) a_[lane] = b_[lane] = c_[lane] = u_[lane] = v_[lane] = variance_[lane] = 0;
    alignas(64) float costs[kPacked];
    for (int from = 0; from < count_; from += kLanes) {
      const auto weight = [&](int n) { return load<Floats>(weight_[n] + from); };
      const auto weighted = [&](int n) { return load<Floats>(weighted_[n] + from); };
      store(costs + from, match_lanes(task_, table_, from, load<Floats>(a_ + from), load<Floats>(b_ + from),
                                      load<Floats>(c_ + from), load<Floats>(u_ + from), load<Floats>(v_ + from),
                                      load<Floats>(variance_ + from), weight, weighted));
    }
    for (int n = 0; n < waiting_; n++) begin(task_, costs + n * task_.source_count, places_[n]);
    count_ = waiting_ = 0;
  }

 private:
  static constexpr int kPacked = (kMaxSources + 15) / 16 * 16;  // lanes: at least all sources of one pixel
  const Task& task_;
  const Table& table_;
  Patch patch_;
  int count_ = 0, waiting_ = 0;
  size_t places_[kPacked];
  alignas(64) float a_[kPacked], b_[kPacked], c_[kPacked], u_[kPacked], v_[kPacked], variance_[kPacked];
  alignas(64) float weight_[kSamples][kPacked] = {}, weighted_[kSamples][kPacked] = {};
};

void begin_row(const Task& t, const Table& table, int y) {
  Pack pack(t, table);
  for (int x = 0; x < t.width; x++) {
    if (wanted(t, size_t(y) * t.width + x)) pack.add(x, y);
  }
  pack.flush();
}

void update_row(const Task& t, const Table& table, int y, int colour, int round) {
  Patch patch(t, table);
  for (int x = (y + colour) & 1; x < t.width; x += 2) {
    const size_t i = size_t(y) * t.width + x;
    if (!wanted(t, i)) continue;
    patch.place(x, y);
    if (patch.variance < kMinVariance) t.costs[i] = kNoMatch;
    else update(t, patch, x, y, round);
  }
}

// Planes with one array per field, and a margin of planes that agree with nothing, so that a row of pixels is a row of
// vectors.
struct Fields {
  int radius, stride;
  std::vector<float> a, b, c, level;

  Fields(const Task& t, int margin, const float* planes)
      : radius(margin), stride(t.width + 2 * margin + kLanes), a(size_t(stride) * t.height), b(a.size()),
        c(a.size(), -1.f), level(a.size()) {
    for (int y = 0; y < t.height; y++) {
      for (int x = 0; x < t.width; x++) {
        const size_t i = size_t(y) * t.width + x, j = at(x, y);
        a[j] = planes[3 * i], b[j] = planes[3 * i + 1], c[j] = planes[3 * i + 2], level[j] = t.gray[i];
      }
    }
  }
  size_t at(int x, int y) const { return size_t(y) * stride + radius + x; }
};

// The sums of kLanes pixels from (x, y) on.
Consensus<Floats> consensus(const Fields& f, int height, float per_gray, float tolerance, int x, int y) {
  alignas(64) float columns[kLanes];
  for (int l = 0; l < kLanes; l++) columns[l] = float(x + l);
  const Floats u = load<Floats>(columns), v = all<Floats>(float(y));
  const size_t here = f.at(x, y);
  const auto predicted = [&](size_t j) {
    return mad(load<Floats>(&f.a[j]), u, mad(load<Floats>(&f.b[j]), v, load<Floats>(&f.c[j])));
  };
  const Floats own = predicted(here), level = load<Floats>(&f.level[here]);
  Consensus<Floats> sums = {};
  for (int row = std::max(0, y - f.radius); row <= std::min(height - 1, y + f.radius); row++) {
    for (size_t j = f.at(x, row) - f.radius; j <= f.at(x, row) + f.radius; j++) {
      const Floats difference = load<Floats>(&f.level[j]) - level;
      sums.add(own, tolerance, difference, per_gray, load<Floats>(&f.a[j]), load<Floats>(&f.b[j]), predicted(j));
    }
  }
  return sums;
}

void average_row(const Task& t, const Fields& f, float tolerance, int y, float* averaged) {
  for (int left = 0; left < t.width; left += kLanes) {
    const int count = std::min(kLanes, t.width - left);
    const size_t start = size_t(y) * t.width + left;
    bool asked = !t.wanted;
    for (int n = 0; n < count; n++) asked |= wanted(t, start + n);
    alignas(64) float total[kLanes] = {}, a[kLanes], b[kLanes], q[kLanes];
    if (asked) {
      const Consensus<Floats> sums = consensus(f, t.height, t.per_gray, tolerance, left, y);
      store(total, sums.total), store(a, sums.a), store(b, sums.b), store(q, sums.q);
    }
    for (int n = 0; n < count; n++) {
      const size_t i = start + n;
      // None where the pixel's own inverse depth is not positive.
      const bool told = total[n] > 0 && wanted(t, i);
      const Plane mean = mean_plane({told ? total[n] : 1.f, a[n], b[n], q[n]}, float(left + n), float(y));
      const Plane plane = told ? mean : plane_at(t, i);
      averaged[3 * i] = plane.a, averaged[3 * i + 1] = plane.b, averaged[3 * i + 2] = plane.c;
    }
  }
}

}  // namespace

extern "C" {

// Match one view: see Task. Its planes are improved in place, after drawing them where it says so; costs and views are
// written.
void d2_patchmatch(const Task* task) {
  const Task& t = *task;
  const std::unique_ptr<const Table> table(new Table(t));
  parallel_rows(t.height, t.threads, [&](int y) { begin_row(t, *table, y); });
  for (int round = 0; round < t.rounds; round++) {
    for (int colour = 0; colour < 2; colour++) {
      parallel_rows(t.height, t.threads, [&](int y) { update_row(t, *table, y, colour, round); });
    }
  }
}

// Average each plane of a task with those of its neighbours that agree, into averaged [H, W, 3]. Where nothing is wanted
// the plane stays as it is.
void d2_consensus(const Task* task, int32_t radius, float tolerance, float* averaged) {
  const Fields fields(*task, radius, task->planes);
  parallel_rows(task->height, task->threads, [&](int y) { average_row(*task, fields, tolerance, y, averaged); });
}

}  // extern "C"

}  // namespace d2
