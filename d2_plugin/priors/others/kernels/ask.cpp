// What the other views say about the mono-only pixels of one: the questions of ask.py, pixel by pixel.
//
// The same operations in the same order as the NumPy code, nothing contracted; logarithms, exponentials and hypotenuses
// are those of the C library. A pixel depends on no other, so results are the same bits for any number of threads.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "parallel.h"

namespace d2 {

// Another view: where our pixels land in it, and its maps [height, width]; logarithms are infinite and depths 0 where
// there is nothing.
struct Other {
  int32_t width, height;
  double A[9], k[3];
  float gain[3];  // how much brighter it shows everything, per channel: filled in here
  const float *mono_log, *surface, *surface_log, *sigma;
  const uint8_t* colors;  // [height, width, 3], or null
};

// What one call works on, as kernel.py fills it in; the numbers are explained in ask.py and evidence.py.
struct Ask {
  int32_t width, height, count, compared, threads, steps, fewest;
  float continuous, like, dark;
  double tolerance, agreeing, at_best, alone, one_place, within, near;
  double beside, nudge, log_nudge, flattest, longest, met, missed;
  double overshot;
  uint8_t label_mono, label_agreed, label_verified;
  Other* others;                  // [count]
  const int64_t *rows, *columns;  // [compared]: some verified pixels
  const float* surface;           // our own, and our own colours
  const uint8_t* colors;
  uint8_t* labels;  // changed in place, as are depth and sigma
  float *depth, *sigma;
};

namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();

struct Place {
  double x, y, z;
};

// A pixel's ray as another view sees it: where its points land is linear in depth.
struct Ray {
  double across, down, ahead;

  Ray(const Other& o, double u, double v)
      : across(o.A[0] * u + o.A[1] * v + o.A[2]),
        down(o.A[3] * u + o.A[4] * v + o.A[5]),
        ahead(o.A[6] * u + o.A[7] * v + o.A[8]) {}

  // Behind the camera at infinity's place, 0.
  Place at(const Other& o, double depth) const {
    const double z = depth * ahead + o.k[2], safe = z > 0 ? z : kInfinity;
    return {(depth * across + o.k[0]) / safe, (depth * down + o.k[1]) / safe, z};
  }
};

// The pixel of another view nearest to a place; -1 outside of the picture and behind the camera.
int64_t nearest(const Other& o, Place at) {
  const bool inside = at.z > 0 && at.x > -0.5 && at.x < o.width - 0.5 && at.y > -0.5 && at.y < o.height - 0.5;
  return inside ? int64_t(std::nearbyint(at.y)) * o.width + int64_t(std::nearbyint(at.x)) : -1;
}

// Depth of another view's surface between the four pixels around a place; 0 where they are no surface.
double between(const Ask& c, const Other& o, Place at) {
  const bool inside = at.z > 0 && at.x >= 0 && at.y >= 0 && at.x <= o.width - 1 && at.y <= o.height - 1;
  if (std::min(o.width, o.height) < 2 || !inside) return 0;
  const int left = std::min(int(at.x), o.width - 2), top = std::min(int(at.y), o.height - 2);
  const double right = at.x - left, down = at.y - top;
  const float* corner = o.surface + int64_t(top) * o.width + left;
  const float a = corner[0], b = corner[1], d = corner[o.width], e = corner[o.width + 1];
  if (!(a > 0 && b > 0 && d > 0 && e > 0)) return 0;  // nor is NaN one
  const float low = std::min(std::min(a, b), std::min(d, e)), high = std::max(std::max(a, b), std::max(d, e));
  if (!(high < c.continuous * low)) return 0;
  const double upper = 1 / double(a) * (1 - right) + 1 / double(b) * right;
  const double lower = 1 / double(d) * (1 - right) + 1 / double(e) * right;
  return 1 / (upper * (1 - down) + lower * down);
}

// Log of a point's depth in the other view over the surface's there; false where that is unknown.
bool miss(const Ask& c, const Other& o, Place at, double* missed) {
  const double there = between(c, o, at);
  *missed = there > 0 ? std::log(at.z / there) : 0;
  return there > 0;
}

// Secant step in log depth towards the surface, 0 where it is not known or runs along the ray.
double step(const Ask& c, const Other& o, const Ray& ray, double depth, double missed) {
  double ahead;
  const bool known = miss(c, o, ray.at(o, depth * c.nudge), &ahead);
  const double slope = (ahead - missed) / c.log_nudge;
  if (!known || !(std::fabs(slope) > c.flattest)) return 0;
  return std::min(std::max(-missed / slope, -c.longest), c.longest);
}

// A mono-only pixel, and the best that the views asked so far said.
struct Asked {
  double depth, sigma;
  float colors[3];
  bool colored, agreed, seen;
  double found, precision;  // depth at which the ray meets a surface, 0 where there is none, and its sigma
};

bool alike(const Ask& c, const Other& o, const Asked& asked, int64_t pixel) {
  if (!asked.colored || !o.colors) return true;
  bool same = true;
  for (int i = 0; i < 3; i++) same &= std::fabs(asked.colors[i] * o.gain[i] - float(o.colors[3 * pixel + i])) < c.like;
  return same;
}

// Follow a ray to the surface of another view. `start` is where it begins there.
void intersect(const Ask& c, const Other& o, const Ray& ray, Place start, Asked* asked) {
  double missed;
  if (!miss(c, o, start, &missed)) return;
  // NaN is no way.
  const double way = c.within * asked->sigma, allowed = way > c.near ? c.near : way;
  const double first = step(c, o, ray, asked->depth, missed);
  if (!(std::fabs(first) < c.overshot * allowed)) return;
  double along = asked->depth * std::exp(first);
  Place at = ray.at(o, along);
  bool known = miss(c, o, at, &missed);
  for (int i = 1; i < c.steps; i++) {
    // Where the surface is not known the ray does not move, so it never will be.
    if (!known) return;
    along = along * std::exp(step(c, o, ray, along, missed));
    at = ray.at(o, along);
    known = miss(c, o, at, &missed);
  }
  const double moved = std::fabs(std::log(along / asked->depth));
  if (!(known && std::fabs(missed) < c.met && moved < allowed)) return;
  const int64_t pixel = nearest(o, at);
  if (!alike(c, o, *asked, pixel)) return;
  asked->seen = true;
  const double precision = std::hypot(double(o.sigma[pixel]), c.beside * moved);
  if (precision < asked->precision) asked->found = along, asked->precision = precision;
}

void ask(const Ask& c, const Other& o, double u, double v, Asked* asked) {
  const Ray ray(o, u, v);
  const Place start = ray.at(o, asked->depth);
  const int64_t pixel = nearest(o, start);
  if (pixel < 0) return;
  const double mono = o.mono_log[pixel], surface = o.surface_log[pixel];
  if (!(std::isfinite(mono) || std::isfinite(surface))) return;
  const double log = std::log(start.z);
  if (std::isfinite(mono)) {
    asked->seen = true;
    if (!asked->agreed && std::fabs(log - mono) < c.tolerance) asked->agreed = alike(c, o, *asked, pixel);
  }
  if (std::fabs(log - surface) < c.missed) intersect(c, o, ray, start, asked);
}

void inform_row(const Ask& c, int row) {
  for (int column = 0; column < c.width; column++) {
    const int64_t pixel = int64_t(row) * c.width + column;
    if (c.labels[pixel] != c.label_mono) continue;
    Asked asked{c.depth[pixel], c.sigma[pixel], {}, c.colors != nullptr, false, false, 0, kInfinity};
    for (int i = 0; asked.colored && i < 3; i++) asked.colors[i] = c.colors[3 * pixel + i];
    for (int i = 0; i < c.count; i++) ask(c, c.others[i], column, row, &asked);
    if (asked.found > 0) {
      c.labels[pixel] = c.label_verified;
      c.depth[pixel] = float(asked.found), c.sigma[pixel] = float(asked.precision);
    } else if (asked.agreed) {
      c.labels[pixel] = c.label_agreed;
      c.sigma[pixel] = float(std::hypot(c.agreeing * asked.sigma, c.at_best));
    } else {
      c.sigma[pixel] = float(std::fabs((asked.seen ? c.alone : 1) * asked.sigma));
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
void compare(const Ask& c, Other* o) {
  if (!c.colors || !o->colors || c.compared < c.fewest) return;
  std::vector<float> ratios[3];
  for (auto& channel : ratios) channel.reserve(c.compared);
  for (int i = 0; i < c.compared; i++) {
    const int64_t pixel = c.rows[i] * c.width + c.columns[i];
    const Place at = Ray(*o, double(c.columns[i]), double(c.rows[i])).at(*o, c.surface[pixel]);
    const int64_t there = nearest(*o, at);
    if (there < 0 || !(std::fabs(std::log(at.z) - o->surface_log[there]) < c.one_place)) continue;
    const uint8_t *mine = c.colors + 3 * pixel, *seen = o->colors + 3 * there;
    if (!(std::min({mine[0], mine[1], mine[2], seen[0], seen[1], seen[2]}) > c.dark)) continue;
    for (int channel = 0; channel < 3; channel++) {
      ratios[channel].push_back(float(seen[channel]) / float(mine[channel]));
    }
  }
  if (int64_t(ratios[0].size()) < c.fewest) return;
  for (int channel = 0; channel < 3; channel++) o->gain[channel] = median(ratios[channel]);
}

}  // namespace
}  // namespace d2

extern "C" {

int64_t d2_ask_size() { return sizeof(d2::Ask); }
int64_t d2_other_size() { return sizeof(d2::Other); }

void d2_inform(const d2::Ask* call) {
  d2::parallel_for(call->threads, call->count, [&](int64_t i) { d2::compare(*call, call->others + i); });
  d2::parallel_for(call->threads, call->height, [&](int64_t row) { d2::inform_row(*call, int(row)); });
}
}
