// PatchMatch multi-view stereo on the CPU: the pixels of spread.h in threads, as many at once as a vector has lanes.
// What they ask for (planes times sources) is packed and matched in the lanes: no sum runs across a vector.
#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "lanes.h"  // before spread.h: templates find what is declared before them
#include "parallel.h"
#include "spread.h"

namespace d2 {
namespace {

constexpr int kRowsAtOnce = 4;  // of one piece of work

// Calls work(top, bottom) in threads until all rows are done, those from top to bottom - 1 at a time.
template <class Work>
void parallel_rows(int rows, int threads, const Work& work) {
  parallel_for(threads, (rows + kRowsAtOnce - 1) / kRowsAtOnce, [&](int64_t part) {
    const int top = int(part) * kRowsAtOnce;
    work(top, std::min(rows, top + kRowsAtOnce));
  });
}

// Where the pixels of a region lie, worked out by the compiler: GCC 13 vectorizes these loops wrongly, and places move.
constexpr auto kPlaces = [] {
  struct { int dx[kRegions][kMostPlaces], dy[kRegions][kMostPlaces]; } places = {};
  for (int region = 0; region < kRegions; region++)
    for (int n = 0; n < region_size(region); n++) region_place(region, n, places.dx[region][n], places.dy[region][n]);
  return places;
}();

// Grey values of the reference with a margin, so that all windows are read alike, and what samples weigh.
struct Reference {
  static constexpr int kMargin = 5;
  static constexpr int kGrays = 256, kDistances = 5;  // of samples from the middle of a window
  int stride;
  std::vector<unsigned> levels;                // -1 outside of the image
  int offset[kSamples];                        // of the samples, in `levels`
  alignas(64) float weight[kDistances][2 * kGrays];  // by distance and difference of grey values, from -256 on

  explicit Reference(const Task& t)
      : stride(t.width + 2 * kMargin), levels(size_t(stride) * (t.height + 2 * kMargin), ~0u) {
    for (int y = 0; y < t.height; y++) std::copy_n(t.gray + size_t(y) * t.width, t.width, &levels[at(0, y)]);
    for (int n = 0; n < kSamples; n++) {
      const int du = sample_du(n), dv = sample_dv(n);
      offset[n] = dv * stride + du;
      if (du < dv || dv < 0) continue;  // each distance once
      for (int k = 0; k < 2 * kGrays; k++) {
        const float off = float(k - kGrays);
        weight[distance(n)][k] = exp2_of(mad(off * off, t.per_gray, log2_spatial(du, dv)));
      }
    }
  }
  // Squared distances are 2, 10, 18, 26 and 34.
  static int distance(int sample) {
    return (sample_du(sample) * sample_du(sample) + sample_dv(sample) * sample_dv(sample)) / 8;
  }
  size_t at(int x, int y) const { return size_t(y + kMargin) * stride + kMargin + x; }
};

// The windows around as many pixels as there are lanes.
struct Windows {
  alignas(64) float weight[kSamples][kLanes], weighted[kSamples][kLanes];
  Floats u, v, variance;

  // columns, rows: of the pixels.
  void place(const Reference& reference, Integers columns, Integers rows) {
    const unsigned* first = &reference.levels[reference.at(0, 0)];
    const Integers at = rows * reference.stride + columns, centre = look_up(first, at);
    Floats level[kSamples], total[kPartials], mean[kPartials], squares[kPartials];
    for (int k = 0; k < kPartials; k++) total[k] = mean[k] = squares[k] = all<Floats>(0.f);
    for (int n = 0; n < kSamples; n++) {
      const Integers read = look_up(first, at + reference.offset[n]), gray = pick(read >= 0, read, centre);
      const float* weights = reference.weight[Reference::distance(n)] + Reference::kGrays;
      const Floats w = pick(read >= 0, look_up(weights, gray - centre), all<Floats>(0.f));
      level[n] = real(gray);
      store(weight[n], w);
      total[n % kPartials] += w, mean[n % kPartials] = mad(w, level[n], mean[n % kPartials]);
    }
    const Floats scale = 1.f / sum_of_partials(total), middle = sum_of_partials(mean) * scale;
    for (int n = 0; n < kSamples; n++) {
      const Floats w = load<Floats>(weight[n]) * scale, off = level[n] - middle, product = w * off;
      store(weight[n], w), store(weighted[n], product);
      squares[n % kPartials] = mad(product, off, squares[n % kPartials]);
    }
    u = real(columns), v = real(rows), variance = sum_of_partials(squares);
  }
};

// Matches that wait until there are as many as lanes, each with its pixel's number in `windows`, its source, and where
// its cost belongs.
class Queue {
 public:
  Queue(const Task& task, const Windows& windows, float* costs) : task_(task), windows_(windows), costs_(costs) {}

  void add(unsigned lanes, const Warp<Floats>& warp, const Source& source, Integers pixel, Integers place) {
    const Floats columns[kPacked] = {warp.x, warp.y, warp.xu, warp.xv, warp.yu, warp.yv, warp.zu, warp.zv,
                                     (Floats)pixel, (Floats)place};
    for (int k = 0; k < kPacked; k++) pack(packed_[k] + count_, lanes, columns[k]);
    store(last_x_ + count_, all<Floats>(last_place(source.width)));
    store(last_y_ + count_, all<Floats>(last_place(source.height)));
    store(first_ + count_, (Floats)(Integers{} + source.first));
    store(stride_ + count_, (Floats)(Integers{} + source.width));
    count_ += __builtin_popcount(lanes);
    if (count_ < kLanes) return;
    match(kLanes);
    count_ -= kLanes;
    for (auto& column : packed_) store(column, load<Floats>(column + kLanes));
    for (float* column : {last_x_, last_y_, first_, stride_}) store(column, load<Floats>(column + kLanes));
  }

  void flush() {
    if (count_ > 0) match(count_);
    count_ = 0;
  }

 private:
  void match(int count) const {
    const auto of = [&](int k) { return load<Floats>(packed_[k]); };
    const Warp<Floats> warp = {of(0), of(1), of(2), of(3), of(4), of(5), of(6), of(7), all<Floats>(1.f)};
    const Floats last_x = load<Floats>(last_x_), last_y = load<Floats>(last_y_);
    alignas(64) float found[kLanes];
    const bool inside = stays_inside(warp, last_x, last_y);
    store(found, inside ? match<true>(warp, last_x, last_y) : match<false>(warp, last_x, last_y));
    const Integers place = load<Integers>(packed_[9]);
    for (int l = 0; l < count; l++) costs_[place[l]] = found[l];
  }

  template <bool bounded>
  Floats match(const Warp<Floats>& warp, Floats last_x, Floats last_y) const {
    const Integers first = load<Integers>(first_), stride = load<Integers>(stride_), pixel = load<Integers>(packed_[8]);
    Sums<Floats> sums = {};
    for (int n = 0; n < kSamples;) {
      const int dv = sample_dv(n), end = dv == -5 || dv == 5 ? n + 4 : n + 6;
      const Line<Floats> line = line_of(warp, all<Floats>(float(dv)));
      for (float du = n + 6 == end ? -5.f : -3.f; n < end; n++, du += 2) {
        const Floats weight = reordered(load<Floats>(windows_.weight[n]), pixel);
        const Floats weighted = reordered(load<Floats>(windows_.weighted[n]), pixel);
        sums.add<bounded>(task_.quads, first, stride, last_x, last_y, warp, line, all<Floats>(du), weight, weighted);
      }
    }
    return sums.cost(reordered(windows_.variance, pixel), warp.seen);
  }

  // Whether all windows lie within their sources, with a quarter of a pixel to spare for what is rounded.
  static bool stays_inside(const Warp<Floats>& warp, Floats last_x, Floats last_y) {
    const Floats zero = all<Floats>(0.f);
    const auto sum = [&](Floats a, Floats b) { return 5.f * (larger(a, zero - a) + larger(b, zero - b)); };
    const Floats e = sum(warp.zu, warp.zv), scale = mad(mad(e, e, e), e, e) + 1.f;
    const Floats x = mad(sum(warp.xu, warp.xv), scale, all<Floats>(.25f));
    const Floats y = mad(sum(warp.yu, warp.yv), scale, all<Floats>(.25f));
    return bits((warp.x >= x) & (warp.y >= y) & (warp.x + x <= last_x) & (warp.y + y <= last_y)) == kAllLanes;
  }

  static constexpr int kPacked = 10;
  const Task& task_;
  const Windows& windows_;
  float* costs_;
  int count_ = 0;
  alignas(64) float packed_[kPacked][2 * kLanes] = {};
  alignas(64) float last_x_[2 * kLanes] = {}, last_y_[2 * kLanes] = {};
  alignas(64) float first_[2 * kLanes] = {}, stride_[2 * kLanes] = {};  // integers, as they are
};

// The planes of the pixels whose windows are placed, and what they cost: [kMaxCandidates, source_count, kLanes].
class Batch {
 public:
  Batch(const Task& task, const Reference& reference)
      : task_(task), reference_(reference), costs_(size_t(kLanes) * kMaxCandidates * task.source_count),
        queue_(task, windows_, costs_.data()) {}

  // Places the windows of `count` pixels; the lanes beyond repeat the last one.
  void place(const int* columns, const int* rows, int count) {
    for (int l = 0; l < kLanes; l++) {
      const int n = std::min(l, count - 1);
      columns_[l] = columns[n], rows_[l] = rows[n];
    }
    windows_.place(reference_, columns_, rows_);
    lanes_ = bits(windows_.variance >= kMinVariance) & ((2u << (count - 1)) - 1);
  }
  Integers columns() const { return columns_; }
  Integers rows() const { return rows_; }
  unsigned lanes() const { return lanes_; }  // bit l says that lane l holds a pixel with texture

  // Matches the planes from number `known` on, where they are used, in the sources whose bit in `views` is 1.
  void match(const Plane<Floats>* planes, const Integers* used, int known, int count, Unsigneds views) {
    unsigned asked[kMaxCandidates];
    for (int k = known; k < count; k++) asked[k] = bits(used[k]) & lanes_;
    for (int s = 0; s < task_.source_count; s++) {
      const unsigned selected = bits((Integers)(views >> s & 1u) > 0);
      const Source& source = task_.sources[s];
      Floats A[9], shift[3];
      for (int e = 0; e < 9; e++) A[e] = all<Floats>(source.A[e]);
      for (int e = 0; e < 3; e++) shift[e] = all<Floats>(source.k[e]);
      const Floats width = all<Floats>(float(source.width)), height = all<Floats>(float(source.height));
      for (int k = known; k < count; k++) {
        if (!(asked[k] & selected)) continue;
        const Plane<Floats>& p = planes[k];
        const Warp<Floats> warp = warp_of(A, shift, width, height, p.a, p.b, p.c, windows_.u, windows_.v);
        const unsigned lanes = asked[k] & selected & bits(warp.seen > 0.f);
        const int first = (k * task_.source_count + s) * kLanes;
        store(&costs_[first], all<Floats>(kNoMatch));
        if (lanes) queue_.add(lanes, warp, source, lane_, lane_ + first);
      }
    }
    queue_.flush();
  }

  Floats cost(int k, int s) const { return load<Floats>(&costs_[(size_t(k) * task_.source_count + s) * kLanes]); }
  void know(int k, int s, Floats cost) { store(&costs_[(size_t(k) * task_.source_count + s) * kLanes], cost); }

 private:
  static Integers numbered() {
    Integers lane;
    for (int l = 0; l < kLanes; l++) lane[l] = l;
    return lane;
  }

  const Task& task_;
  const Reference& reference_;
  Windows windows_;
  const Integers lane_ = numbered();
  Integers columns_ = {}, rows_ = {};
  unsigned lanes_ = 0;
  std::vector<float> costs_;
  Queue queue_;
};

// cheapest_of for the pixels at `columns` and `rows`.
Integers cheapest_of(const Task& t, Integers columns, Integers rows, int region) {
  const Integers here = rows * t.width + columns;
  Floats lowest = all<Floats>(1e9f);
  Integers found = Integers{} - 1;
  for (int n = 0; n < region_size(region); n++) {
    const int dx = kPlaces.dx[region][n], dy = kPlaces.dy[region][n];
    // As if they had no sign, numbers below 0 are large.
    const Unsigneds x = (Unsigneds)(columns + dx), y = (Unsigneds)(rows + dy);
    const Integers inside = (Integers)(x < unsigned(t.width)) & (Integers)(y < unsigned(t.height));
    const Integers at = pick(inside, here + (dy * t.width + dx), here);
    const Floats cost = look_up(t.costs, at);
    const Integers better = inside & (cost < lowest);
    lowest = pick(better, cost, lowest), found = pick(better, at, found);
  }
  return found;
}

// Calls work(columns, rows, count) with the wanted pixels of rows top to bottom - 1, kLanes at a time: all of them, or
// those of one colour.
template <class Work>
void wanted_pixels(const Task& t, int top, int bottom, int step, int colour, const Work& work) {
  int columns[kLanes], rows[kLanes], count = 0;
  for (int y = top; y < bottom; y++) {
    for (int x = step == 2 ? (y + colour) & 1 : 0; x < t.width; x += step) {
      if (wanted(t, (long long)y * t.width + x)) columns[count] = x, rows[count++] = y;
      if (count == kLanes) work(columns, rows, count), count = 0;
    }
  }
  if (count) work(columns, rows, count);
}

// first_costs [source_count, H, W]: of the planes that the pixels start with.
void begin_rows(const Task& t, const Reference& reference, float* first_costs, int top, int bottom) {
  Batch batch(t, reference);
  const size_t size = size_t(t.width) * t.height;
  wanted_pixels(t, top, bottom, 1, 0, [&](const int* columns, const int* rows, int count) {
    batch.place(columns, rows, count);
    Plane<Floats> planes = {};
    for (int n = 0; n < count; n++) {
      const Plane<float> plane = drawn_plane(t, columns[n], rows[n]);
      planes.a[n] = plane.a, planes.b[n] = plane.b, planes.c[n] = plane.c;
    }
    for (int s = 0; s < t.source_count; s++) batch.know(0, s, all<Floats>(kNoMatch));
    const Integers used = Integers{} - 1;
    batch.match(&planes, &used, 0, 1, Unsigneds{} - 1u);
    for (int n = 0; n < count; n++) {
      const size_t i = size_t(rows[n]) * t.width + columns[n];
      float costs[kMaxSources];
      for (int s = 0; s < t.source_count; s++) costs[s] = first_costs[s * size + i] = batch.cost(0, s)[n];
      begin(t, costs, (long long)i);
    }
  });
}

void update_rows(const Task& t, const Reference& reference, const float* first_costs, int top, int bottom, int colour,
                 int round) {
  Batch batch(t, reference);
  const auto cost = [&](int k, int s) { return batch.cost(k, s); };
  wanted_pixels(t, top, bottom, 2, colour, [&](const int* columns, const int* rows, int count) {
    batch.place(columns, rows, count);
    Turn<Floats> turn(t, batch.columns(), batch.rows(), round);
    const auto textured = [&](int n) { return batch.lanes() >> n & 1; };
    for (int n = 0; n < count; n++)
      if (!textured(n)) t.costs[turn.pixel[n]] = kNoMatch;
    if (!batch.lanes()) return;
    turn.gather([&](int region) { return cheapest_of(t, batch.columns(), batch.rows(), region); });
    const int known = round == 0 ? 1 : 0;  // nobody else has changed the plane that a pixel starts with
    for (int s = 0; s < t.source_count * known; s++)
      batch.know(0, s, look_up(first_costs + size_t(s) * t.width * t.height, turn.pixel));
    batch.match(turn.planes, turn.used, known, turn.count, Unsigneds{} - 1u);
    turn.choose(cost, [&](int k, int s) { return belief_of(batch.cost(k, s)); });
    const auto match_drawn = [&] {
      batch.match(turn.planes, turn.used, 0, turn.count, turn.selection.views);
      turn.compare(cost);
    };
    if (t.explore) turn.draw_anywhere(), match_drawn();
    turn.draw_nearby(), match_drawn();
    for (int n = 0; n < count; n++) {
      if (!textured(n)) continue;
      const int i = turn.pixel[n];
      put(t, i, {turn.best.a[n], turn.best.b[n], turn.best.c[n]});
      t.costs[i] = turn.cost[n], t.views[i] = turn.selection.views[n];
    }
  });
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
      const Plane<float> mean = mean_plane({told ? total[n] : 1.f, a[n], b[n], q[n]}, float(left + n), float(y));
      const Plane<float> plane = told ? mean : plane_at(t, i);
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
  const Reference reference(t);
  std::vector<float> first_costs(size_t(t.width) * t.height * t.source_count);
  parallel_rows(t.height, t.threads, [&](int top, int bottom) {
    begin_rows(t, reference, first_costs.data(), top, bottom);
  });
  for (int round = 0; round < t.rounds; round++) {
    for (int colour = 0; colour < 2; colour++) {
      const auto update = [&](int top, int bottom) {
        update_rows(t, reference, first_costs.data(), top, bottom, colour, round);
      };
      parallel_rows(t.height, t.threads, update);
    }
  }
}

// Average each plane of a task with those of its neighbours that agree, into averaged [H, W, 3]. Where nothing is wanted
// the plane stays as it is.
void d2_consensus(const Task* task, int32_t radius, float tolerance, float* averaged) {
  const Fields fields(*task, radius, task->planes);
  parallel_rows(task->height, task->threads, [&](int top, int bottom) {
    for (int y = top; y < bottom; y++) average_row(*task, fields, tolerance, y, averaged);
  });
}

}  // extern "C"

}  // namespace d2
