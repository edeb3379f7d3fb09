// Planes in space as PatchMatch uses them: inverse depth is linear over the picture, 1/z(u, v) = a u + b v + c.
// Pixel coordinates are array indices: the centre of pixel i is at i, and the intrinsics passed in say so too.
#pragma once

#include <cmath>
#include <cstdint>

namespace d2 {

struct Vector {
  float x, y, z;
};

struct Intrinsics {
  float fx, fy, cx, cy;

  Vector ray(float u, float v) const { return {(u - cx) / fx, (v - cy) / fy, 1.f}; }
};

struct Plane {
  float a, b, c;

  float inverse_depth(float u, float v) const { return a * u + b * v + c; }
  bool operator==(const Plane& other) const { return a == other.a && b == other.b && c == other.c; }
};

inline float dot(Vector p, Vector q) { return p.x * q.x + p.y * q.y + p.z * q.z; }

inline Vector normalised(Vector p) {
  const float length = std::sqrt(dot(p, p));
  const float scale = length > 0 ? 1.f / length : 0.f;
  return {p.x * scale, p.y * scale, p.z * scale};
}

// The plane with normal n through pixel (u, v) at inverse depth q: n.X = d, hence 1/z = n.ray / d.
inline Plane plane_through(const Intrinsics& k, float u, float v, float q, Vector n) {
  const float scale = q / dot(n, k.ray(u, v));
  const float a = n.x * scale / k.fx, b = n.y * scale / k.fy;
  return {a, b, n.z * scale - a * k.cx - b * k.cy};
}

// The unit normal that faces the camera (its product with the ray of any visible pixel is negative).
inline Vector normal_of(const Intrinsics& k, const Plane& plane) {
  const Vector inward =
      normalised({plane.a * k.fx, plane.b * k.fy, plane.c + plane.a * k.cx + plane.b * k.cy});
  return {-inward.x, -inward.y, -inward.z};
}

// Cosine of the angle between the normal and the direction back to the camera.
inline float facing(const Intrinsics& k, Vector n, float u, float v) { return -dot(n, normalised(k.ray(u, v))); }

// Random numbers of one pixel in one round: they depend on nothing else, so any number of threads draws the same.
class Random {
 public:
  Random(uint32_t seed, uint32_t pixel, uint32_t round) : state_(mix(mix(mix(seed) + pixel) + round) | 1u) {}

  // Uniform in [low, high); xorshift32.
  float uniform(float low, float high) {
    state_ ^= state_ << 13;
    state_ ^= state_ >> 17;
    state_ ^= state_ << 5;
    return low + (high - low) * (float(state_ >> 8) * (1.f / 16777216.f));
  }

 private:
  // A bijection of 32 bits in which every bit of the argument changes half of the result ("lowbias32", C. Wellons).
  static uint32_t mix(uint32_t h) {
    h ^= h >> 16;
    h *= 0x7feb352du;
    h ^= h >> 15;
    h *= 0x846ca68bu;
    return h ^ (h >> 16);
  }

  uint32_t state_;
};

// A random direction towards the camera, at most 75 degrees from the viewing ray (Marsaglia's disk method).
inline Vector random_normal(const Intrinsics& k, float u, float v, Random& random) {
  for (;;) {
    const float s = random.uniform(-1, 1), t = random.uniform(-1, 1), square = s * s + t * t;
    if (square >= 1) continue;
    const float scale = 2 * std::sqrt(1 - square);
    Vector n{s * scale, t * scale, 1 - 2 * square};
    float cosine = facing(k, n, u, v);
    if (cosine < 0) n = {-n.x, -n.y, -n.z}, cosine = -cosine;
    if (cosine > .25f) return n;
  }
}

// `n` turned by a random amount; the old one where four draws all turn it away from the camera.
inline Vector jittered_normal(const Intrinsics& k, float u, float v, Vector n, float amount, Random& random) {
  for (int attempt = 0; attempt < 4; attempt++, amount *= .5f) {
    const Vector turned = normalised({n.x + amount * random.uniform(-1, 1), n.y + amount * random.uniform(-1, 1),
                                      n.z + amount * random.uniform(-1, 1)});
    if (facing(k, turned, u, v) > .15f) return turned;
  }
  return n;
}

}  // namespace d2
