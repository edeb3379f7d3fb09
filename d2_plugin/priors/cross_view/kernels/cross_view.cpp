// The mono-only pixels of each view of an instant compared with the other views (see evidence.py), pixel by pixel.
//
// Nothing is contracted; logarithms, exponentials and hypotenuses are those of the C library. A pixel depends on no
// other, so results are the same bits for any number of threads.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "parallel.h"

namespace d2 {

// One view: its maps [height, width], and those that the call changes.
struct View {
  int32_t width, height;
  double agreeing;  // factor of sigma where another map agrees
  const uint8_t* labels;
  const float *depth, *log, *sigma;  // the logarithm is infinite where there is no depth
  const uint8_t* colors;             // [height, width, 3], or null
  uint8_t* new_labels;
  float *new_depth, *new_sigma;
};

// Where the pixels of one view land in another.
struct Pair {
  double A[9], k[3];
  float gain[3];  // how much brighter the other shows everything, per channel: filled in here
};

// What one call works on, as kernel.py fills it in; the numbers are explained there and in evidence.py.
struct Instant {
  int32_t count, threads, compared, steps, fewest;
  float continuous, like, dark;
  double tolerance, at_best, alone, one_place, within, near, beside;
  double nudge, log_nudge, flattest, longest, met, missed, overshot;
  uint8_t label_mono, label_agreed, label_verified;
  const View* views;  // [count]
  Pair* pairs;        // [count, count], of the view whose pixels are compared and of the other
};

namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();

struct Place {
  double x, y, z;
};

// What a view verified, prepared for the comparison.
struct Surface {
  std::vector<float> depth;     // 0 elsewhere
  std::vector<double> inverse;  // 0 elsewhere
  std::vector<int64_t> some;    // pixels, evenly over the image

  void read(const Instant& c, const View& view) {
    const int64_t size = int64_t(view.width) * view.height;
    depth.resize(size), inverse.resize(size);
    int64_t count = 0;
    for (int64_t i = 0; i < size; i++) {
      const bool known = (view.labels[i] == c.label_verified) & (view.depth[i] > 0);
      depth[i] = known ? view.depth[i] : 0;
      inverse[i] = known ? 1 / double(view.depth[i]) : 0;
      count += known;
    }
    const int64_t every = std::max<int64_t>(count / c.compared, 1);
    for (int64_t i = 0, seen = 0; i < size; i++) {
      if (depth[i] > 0 && seen++ % every == 0) some.push_back(i);
    }
  }
};

// Another view, as one view is compared with it.
struct Other {
  const View& view;
  const Surface& surface;
  const Pair& pair;
};

// A pixel's ray as another view sees it: where its points land is linear in depth.
struct Ray {
  double across, down, ahead;

  Ray(const Pair& p, double u, double v)
      : across(p.A[0] * u + p.A[1] * v + p.A[2]),
        down(p.A[3] * u + p.A[4] * v + p.A[5]),
        ahead(p.A[6] * u + p.A[7] * v + p.A[8]) {}

  // Behind the camera at infinity's place, 0.
  Place at(const Pair& p, double depth) const {
    const double z = depth * ahead + p.k[2], safe = z > 0 ? z : kInfinity;
    return {(depth * across + p.k[0]) / safe, (depth * down + p.k[1]) / safe, z};
  }
};

// The pixel of another view nearest to a place; -1 outside of the image and behind the camera.
int64_t nearest(const View& view, Place at) {
  const double right = view.width - 0.5, bottom = view.height - 0.5;
  const bool inside = (at.z > 0) & (at.x > -0.5) & (at.x < right) & (at.y > -0.5) & (at.y < bottom);
  return inside ? int64_t(std::nearbyint(at.y)) * view.width + int64_t(std::nearbyint(at.x)) : -1;
}

// Depth of another view's surface between the four pixels around a place; 0 where they are no surface.
double between(const Instant& c, const Other& o, Place at) {
  const int width = o.view.width, height = o.view.height;
  const bool inside = at.z > 0 && at.x >= 0 && at.y >= 0 && at.x <= width - 1 && at.y <= height - 1;
  if (std::min(width, height) < 2 || !inside) return 0;
  const int left = std::min(int(at.x), width - 2), top = std::min(int(at.y), height - 2);
  const double right = at.x - left, down = at.y - top;
  const int64_t first = int64_t(top) * width + left;
  const float* corner = o.surface.depth.data() + first;
  const float a = corner[0], b = corner[1], d = corner[width], e = corner[width + 1];
  const float low = std::min(std::min(a, b), std::min(d, e)), high = std::max(std::max(a, b), std::max(d, e));
  if (!(low > 0 && high < c.continuous * low)) return 0;
  const double* inverse = o.surface.inverse.data() + first;
  const double upper = inverse[0] * (1 - right) + inverse[1] * right;
  const double lower = inverse[width] * (1 - right) + inverse[width + 1] * right;
  return 1 / (upper * (1 - down) + lower * down);
}

// Log of a point's depth in the other view over the surface's there; false where that is unknown.
bool miss(const Instant& c, const Other& o, Place at, double* missed) {
  const double there = between(c, o, at);
  *missed = there > 0 ? std::log(at.z / there) : 0;
  return there > 0;
}

// Secant step in log depth towards the surface, 0 where it is not known or runs along the ray.
double step(const Instant& c, const Other& o, const Ray& ray, double depth, double missed) {
  double ahead;
  const bool known = miss(c, o, ray.at(o.pair, depth * c.nudge), &ahead);
  const double slope = (ahead - missed) / c.log_nudge;
  if (!known || !(std::fabs(slope) > c.flattest)) return 0;
  return std::min(std::max(-missed / slope, -c.longest), c.longest);
}

// A mono-only pixel, and the best that the views so far showed of it.
struct MonoPixel {
  double depth, sigma;
  const uint8_t* colors;  // or null
  bool agreed, seen;
  double met, precision;  // depth at which the ray meets a surface, 0 where there is none, and its sigma
};

bool alike(const Instant& c, const Other& o, const MonoPixel& point, int64_t pixel) {
  if (!point.colors || !o.view.colors) return true;
  bool same = true;
  const uint8_t* theirs = o.view.colors + 3 * pixel;
  for (int i = 0; i < 3; i++) same &= std::fabs(point.colors[i] * o.pair.gain[i] - theirs[i]) < c.like;
  return same;
}

// Follow a ray to the surface of another view. `start` is where it begins there.
void intersect(const Instant& c, const Other& o, const Ray& ray, Place start, MonoPixel* point) {
  double missed;
  if (!miss(c, o, start, &missed)) return;
  // NaN is no way.
  const double way = c.within * point->sigma, allowed = way > c.near ? c.near : way;
  const double first = step(c, o, ray, point->depth, missed);
  if (!(std::fabs(first) < c.overshot * allowed)) return;
  double along = point->depth * std::exp(first);
  Place at = ray.at(o.pair, along);
  bool known = miss(c, o, at, &missed);
  for (int i = 1; i < c.steps; i++) {
    // Where the surface is not known the ray does not move, so it never will be.
    if (!known) return;
    along = along * std::exp(step(c, o, ray, along, missed));
    at = ray.at(o.pair, along);
    known = miss(c, o, at, &missed);
  }
  const double moved = std::fabs(std::log(along / point->depth));
  if (!(known && std::fabs(missed) < c.met && moved < allowed)) return;
  const int64_t pixel = nearest(o.view, at);
  if (!alike(c, o, *point, pixel)) return;
  point->seen = true;
  const double precision = std::hypot(double(o.view.sigma[pixel]), c.beside * moved);
  if (precision < point->precision) point->met = along, point->precision = precision;
}

void compare_pixel(const Instant& c, const Other& o, double u, double v, Place start, MonoPixel* point) {
  const int64_t pixel = nearest(o.view, start);
  if (pixel < 0) return;
  const uint8_t label = o.view.labels[pixel];
  const bool mono = label == c.label_mono || label == c.label_agreed;
  const double there = o.view.log[pixel];
  if (!(mono || label == c.label_verified) || !std::isfinite(there)) return;
  if (mono) point->seen = true;
  if (mono && point->agreed) return;
  const double apart = std::fabs(std::log(start.z) - there);
  if (mono) {
    point->agreed = apart < c.tolerance && alike(c, o, *point, pixel);
  } else if (apart < c.missed) {
    intersect(c, o, Ray(o.pair, u, v), start, point);
  }
}

// The mono-only pixels of a row, packed, and where they land in another view.
struct Row {
  std::vector<double> u, depth, x, y, z;
  std::vector<MonoPixel> pixels;

  // A plain loop, which compilers turn into vectors.
  void land(Pair pair, double v) {
    const int64_t count = u.size();
    const double *column = u.data(), *deep = depth.data();
    double *__restrict__ to_x = x.data(), *__restrict__ to_y = y.data(), *__restrict__ to_z = z.data();
    for (int64_t j = 0; j < count; j++) {
      const Place at = Ray(pair, column[j], v).at(pair, deep[j]);
      to_x[j] = at.x, to_y[j] = at.y, to_z[j] = at.z;
    }
  }
};

void compare_row(const Instant& c, const std::vector<Surface>& surfaces, int index, int row) {
  const View& view = c.views[index];
  Row r;
  for (int column = 0; column < view.width; column++) {
    const int64_t pixel = int64_t(row) * view.width + column;
    if (view.labels[pixel] != c.label_mono) continue;
    const uint8_t* colors = view.colors ? view.colors + 3 * pixel : nullptr;
    r.u.push_back(column), r.depth.push_back(view.depth[pixel]);
    r.pixels.push_back({view.depth[pixel], view.sigma[pixel], colors, false, false, 0, kInfinity});
  }
  const int64_t count = r.u.size();
  r.x.resize(count), r.y.resize(count), r.z.resize(count);
  for (int i = 0; i < c.count; i++) {
    if (i == index) continue;
    const Other other{c.views[i], surfaces[i], c.pairs[index * c.count + i]};
    r.land(other.pair, row);
    for (int64_t j = 0; j < count; j++) compare_pixel(c, other, r.u[j], row, {r.x[j], r.y[j], r.z[j]}, &r.pixels[j]);
  }
  for (int64_t j = 0; j < count; j++) {
    const MonoPixel& point = r.pixels[j];
    const int64_t pixel = int64_t(row) * view.width + int64_t(r.u[j]);
    if (point.met > 0) {
      view.new_labels[pixel] = c.label_agreed;
      view.new_depth[pixel] = float(point.met), view.new_sigma[pixel] = float(point.precision);
    } else if (point.agreed) {
      view.new_labels[pixel] = c.label_agreed;
      view.new_sigma[pixel] = float(std::hypot(view.agreeing * point.sigma, c.at_best));
    } else {
      view.new_sigma[pixel] = float(std::fabs((point.seen ? c.alone : 1) * point.sigma));
    }
  }
}

float median(std::vector<float>& values) {
  const auto middle = values.begin() + values.size() / 2;
  std::nth_element(values.begin(), middle, values.end());
  if (values.size() % 2) return *middle;
  return (*std::max_element(values.begin(), middle) + *middle) / 2;
}

// How much brighter another camera shows what both verified; left as it is where that is too little.
void measure_gain(const Instant& c, const View& ours, const Surface& surface, const View& theirs, Pair* pair) {
  if (!ours.colors || !theirs.colors || int64_t(surface.some.size()) < c.fewest) return;
  std::vector<float> ratios[3];
  for (auto& channel : ratios) channel.reserve(surface.some.size());
  for (const int64_t pixel : surface.some) {
    const double u = double(pixel % ours.width), v = double(pixel / ours.width);
    const Place at = Ray(*pair, u, v).at(*pair, surface.depth[pixel]);
    const int64_t there = nearest(theirs, at);
    if (there < 0 || theirs.labels[there] != c.label_verified) continue;
    const uint8_t *mine = ours.colors + 3 * pixel, *seen = theirs.colors + 3 * there;
    if (!(std::min({mine[0], mine[1], mine[2], seen[0], seen[1], seen[2]}) > c.dark)) continue;
    if (!(std::fabs(std::log(at.z) - theirs.log[there]) < c.one_place)) continue;
    for (int i = 0; i < 3; i++) ratios[i].push_back(float(seen[i]) / float(mine[i]));
  }
  if (int64_t(ratios[0].size()) < c.fewest) return;
  for (int i = 0; i < 3; i++) pair->gain[i] = median(ratios[i]);
}

void compare_views(const Instant& c) {
  std::vector<Surface> surfaces(c.count);
  parallel_for(c.threads, c.count, [&](int64_t i) { surfaces[i].read(c, c.views[i]); });
  parallel_for(c.threads, int64_t(c.count) * c.count, [&](int64_t i) {
    const int64_t ours = i / c.count, theirs = i % c.count;
    if (ours != theirs) measure_gain(c, c.views[ours], surfaces[ours], c.views[theirs], c.pairs + i);
  });
  for (int i = 0; i < c.count; i++) {
    parallel_for(c.threads, c.views[i].height, [&](int64_t row) { compare_row(c, surfaces, i, int(row)); });
  }
}

}  // namespace
}  // namespace d2

extern "C" {

int64_t d2_instant_size() { return sizeof(d2::Instant); }
int64_t d2_pair_size() { return sizeof(d2::Pair); }
int64_t d2_view_size() { return sizeof(d2::View); }

void d2_compare_views(const d2::Instant* call) { d2::compare_views(*call); }
}
