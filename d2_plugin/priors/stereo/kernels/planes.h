// Planes in space as PatchMatch uses them: inverse depth is linear over the image, 1/z(u, v) = a u + b v + c.
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

template <class S>
struct Vector {
  S x, y, z;

  D2_FN Vector operator-() const { return {-x, -y, -z}; }
};

template <class S>
D2_FN Vector<S> pick(Mask<S> yes, const Vector<S>& p, const Vector<S>& q) {
  return {pick(yes, p.x, q.x), pick(yes, p.y, q.y), pick(yes, p.z, q.z)};
}

template <class S>
D2_FN S dot(const Vector<S>& p, const Vector<S>& q) { return mad(p.x, q.x, mad(p.y, q.y, p.z * q.z)); }

template <class S>
D2_FN Vector<S> normalised(const Vector<S>& p) {
  const S length = root(dot(p, p));
  const S scale = pick(length > 0.f, 1.f / length, all<S>(0.f));
  return {p.x * scale, p.y * scale, p.z * scale};
}

struct Intrinsics {
  float fx, fy, cx, cy;
};

// How the camera sees a pixel.
template <class S>
struct Sight {
  S u, v;
  Vector<S> ray, direction;  // through the pixel: with z = 1, and of length 1
};

template <class S>
D2_FN Sight<S> sight_of(const Intrinsics& k, S u, S v) {
  const Vector<S> ray = {(u - k.cx) / k.fx, (v - k.cy) / k.fy, all<S>(1.f)};
  return {u, v, ray, normalised(ray)};
}

template <class S>
struct Plane {
  S a, b, c;

  D2_FN S inverse_depth(S u, S v) const { return mad(a, u, mad(b, v, c)); }
  D2_FN Mask<S> operator==(const Plane& other) const { return (a == other.a) & (b == other.b) & (c == other.c); }
};

template <class S>
D2_FN Plane<S> pick(Mask<S> yes, const Plane<S>& p, const Plane<S>& q) {
  return {pick(yes, p.a, q.a), pick(yes, p.b, q.b), pick(yes, p.c, q.c)};
}

// The plane with normal n through a pixel at inverse depth q: n.X = d, hence 1/z = n.ray / d.
template <class S>
D2_FN Plane<S> plane_through(const Intrinsics& k, const Sight<S>& sight, S q, const Vector<S>& n) {
  const S scale = q / dot(n, sight.ray);
  const S a = n.x * scale / k.fx, b = n.y * scale / k.fy;
  return {a, b, mad(-b, all<S>(k.cy), mad(-a, all<S>(k.cx), n.z * scale))};
}

// The unit normal that faces the camera (its product with the ray of any visible pixel is negative).
template <class S>
D2_FN Vector<S> normal_of(const Intrinsics& k, const Plane<S>& p) {
  const Vector<S> inward = {p.a * k.fx, p.b * k.fy, mad(p.a, all<S>(k.cx), mad(p.b, all<S>(k.cy), p.c))};
  return -normalised(inward);
}

// Cosine of the angle between the normal and the direction back to the camera.
template <class S>
D2_FN S facing(const Vector<S>& n, const Sight<S>& sight) { return -dot(n, sight.direction); }

// Random numbers of one pixel in one round: they depend on nothing else, so any number of threads draws the same.
template <class S>
class Random {
 public:
  D2_FN Random(unsigned seed, Word<S> pixel, unsigned round) : state_(mix(mix(mix(seed) + pixel) + round) | 1u) {}

  // Uniform in [low, high); xorshift32.
  D2_FN S uniform(float low, float high) {
    state_ ^= state_ << 13;
    state_ ^= state_ >> 17;
    state_ ^= state_ << 5;
    return mad(all<S>(high - low), real((Whole<S>)(state_ >> 8)) * (1.f / 16777216.f), all<S>(low));
  }

  // Goes on as `other` where `yes`.
  D2_FN void follow(Mask<S> yes, const Random& other) { state_ = pick(yes, other.state_, state_); }

 private:
  // A bijection of 32 bits in which every bit of the argument changes half of the result ("lowbias32", C. Wellons).
  template <class W>
  static D2_FN W mix(W h) {
    h ^= h >> 16;
    h *= 0x7feb352du;
    h ^= h >> 15;
    h *= 0x846ca68bu;
    return h ^ (h >> 16);
  }

  Word<S> state_;
};

// A random direction towards the camera, at most 75 degrees from the viewing ray (Marsaglia's disk method).
template <class S>
D2_FN Vector<S> random_normal(const Sight<S>& sight, Random<S>& random) {
  Vector<S> found = {};
  for (Mask<S> left = sight.u == sight.u; !none(left);) {
    Random<S> next = random;
    const S s = next.uniform(-1, 1), t = next.uniform(-1, 1), square = mad(s, s, t * t);
    random.follow(left, next);
    const S scale = 2.f * root(larger(1.f - square, all<S>(0.f)));
    const Vector<S> n = {s * scale, t * scale, 1.f - 2.f * square};
    const S cosine = facing(n, sight);
    const Mask<S> good = left & (square < 1.f) & ((cosine > .25f) | (cosine < -.25f));
    found = pick(good, pick(cosine < 0.f, -n, n), found);
    left = left & opposite(good);
  }
  return found;
}

// `n` turned by a random amount; the old one where four draws all turn it away from the camera.
template <class S>
D2_FN Vector<S> jittered_normal(const Sight<S>& sight, const Vector<S>& n, float amount, Random<S>& random) {
  Vector<S> found = n;
  Mask<S> left = sight.u == sight.u;
  for (int attempt = 0; attempt < 4 && !none(left); attempt++, amount *= .5f) {
    Random<S> next = random;
    const S x = next.uniform(-1, 1), y = next.uniform(-1, 1), z = next.uniform(-1, 1);
    random.follow(left, next);
    const S change = all<S>(amount);
    const Vector<S> turned = normalised(Vector<S>{mad(change, x, n.x), mad(change, y, n.y), mad(change, z, n.z)});
    const Mask<S> good = left & (facing(turned, sight) > .15f);
    found = pick(good, turned, found);
    left = left & opposite(good);
  }
  return found;
}

}  // namespace d2
