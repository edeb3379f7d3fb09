// Planes in space as PatchMatch uses them: inverse depth is linear over the picture, 1/z(u, v) = a u + b v + c.
// Pixel coordinates are array indices: the centre of pixel i is at i, and the intrinsics passed in say so too.
//
// This and the headers beside it are the mathematics of PatchMatch, once, for CPU and GPU. Every sum has one order.
#pragma once

#include "numbers.h"

namespace d2 {

// S is one number, or a vector of them on the CPU (lanes.h); a scalar in every lane.
template <class S>
D2_FN S all(float a) { return a - S{}; }  // not a sum, which loses the sign of -0

// 2^x for x <= 0, to 2e-7 of it; 2^-126 below -126.
template <class S>
D2_FN S exp2_of(S x) {
  const S y = larger(x, all<S>(-126.f));
  const auto n = whole(y - .5f);  // the nearest integer, since y <= 0
  const S f = y - real(n);
  S p = all<S>(1.535336e-4f);
  p = mad(p, f, all<S>(1.339887e-3f)), p = mad(p, f, all<S>(9.618437e-3f)), p = mad(p, f, all<S>(5.550333e-2f));
  p = mad(p, f, all<S>(2.402265e-1f)), p = mad(p, f, all<S>(6.931472e-1f)), p = mad(p, f, all<S>(1.f));
  return p * bits_float((n + 127) << 23);
}
constexpr float kLog2E = 1.44269504f;
D2_FN float exp_of(float x) { return exp2_of(kLog2E * x); }

struct Vector {
  float x, y, z;
};

D2_FN float dot(Vector p, Vector q) { return mad(p.x, q.x, mad(p.y, q.y, p.z * q.z)); }

D2_FN Vector normalised(Vector p) {
  const float length = root(dot(p, p));
  const float scale = length > 0 ? 1.f / length : 0.f;
  return {p.x * scale, p.y * scale, p.z * scale};
}

struct Intrinsics {
  float fx, fy, cx, cy;
};

// How the camera sees a pixel.
struct Sight {
  float u, v;
  Vector ray, direction;  // through the pixel: with z = 1, and of length 1
};

D2_FN Sight sight_of(const Intrinsics& k, float u, float v) {
  const Vector ray = {(u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.f};
  return {u, v, ray, normalised(ray)};
}

struct Plane {
  float a, b, c;

  D2_FN float inverse_depth(float u, float v) const { return mad(a, u, mad(b, v, c)); }
  D2_FN bool operator==(const Plane& other) const { return a == other.a && b == other.b && c == other.c; }
};

// The plane with normal n through a pixel at inverse depth q: n.X = d, hence 1/z = n.ray / d.
D2_FN Plane plane_through(const Intrinsics& k, const Sight& sight, float q, Vector n) {
  const float scale = q / dot(n, sight.ray);
  const float a = n.x * scale / k.fx, b = n.y * scale / k.fy;
  return {a, b, mad(-b, k.cy, mad(-a, k.cx, n.z * scale))};
}

// The unit normal that faces the camera (its product with the ray of any visible pixel is negative).
D2_FN Vector normal_of(const Intrinsics& k, const Plane& p) {
  const Vector inward = normalised({p.a * k.fx, p.b * k.fy, mad(p.a, k.cx, mad(p.b, k.cy, p.c))});
  return {-inward.x, -inward.y, -inward.z};
}

// Cosine of the angle between the normal and the direction back to the camera.
D2_FN float facing(Vector n, const Sight& sight) { return -dot(n, sight.direction); }

// Random numbers of one pixel in one round: they depend on nothing else, so any number of threads draws the same.
class Random {
 public:
  D2_FN Random(unsigned seed, unsigned pixel, unsigned round) : state_(mix(mix(mix(seed) + pixel) + round) | 1u) {}

  // Uniform in [low, high); xorshift32.
  D2_FN float uniform(float low, float high) {
    state_ ^= state_ << 13;
    state_ ^= state_ >> 17;
    state_ ^= state_ << 5;
    return mad(high - low, float(state_ >> 8) * (1.f / 16777216.f), low);
  }

 private:
  // A bijection of 32 bits in which every bit of the argument changes half of the result ("lowbias32", C. Wellons).
  static D2_FN unsigned mix(unsigned h) {
    h ^= h >> 16;
    h *= 0x7feb352du;
    h ^= h >> 15;
    h *= 0x846ca68bu;
    return h ^ (h >> 16);
  }

  unsigned state_;
};

// A random direction towards the camera, at most 75 degrees from the viewing ray (Marsaglia's disk method).
D2_FN Vector random_normal(const Sight& sight, Random& random) {
  for (;;) {
    const float s = random.uniform(-1, 1), t = random.uniform(-1, 1), square = mad(s, s, t * t);
    if (square >= 1) continue;
    const float scale = 2 * root(1 - square);
    Vector n{s * scale, t * scale, 1 - 2 * square};
    float cosine = facing(n, sight);
    if (cosine < 0) n = {-n.x, -n.y, -n.z}, cosine = -cosine;
    if (cosine > .25f) return n;
  }
}

// `n` turned by a random amount; the old one where four draws all turn it away from the camera.
D2_FN Vector jittered_normal(const Sight& sight, Vector n, float amount, Random& random) {
  for (int attempt = 0; attempt < 4; attempt++, amount *= .5f) {
    const float x = random.uniform(-1, 1), y = random.uniform(-1, 1), z = random.uniform(-1, 1);
    const Vector turned = normalised({mad(amount, x, n.x), mad(amount, y, n.y), mad(amount, z, n.z)});
    if (facing(turned, sight) > .15f) return turned;
  }
  return n;
}

}  // namespace d2
