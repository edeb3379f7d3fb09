// The mathematics of splatting, once, for every device: what one Gaussian looks like on the screen, what one fragment
// contributes, and both backwards. The callers only walk over Gaussians and pixels.
//
// S is the scalar: float in CUDA, a vector of 4 to 16 floats on the CPU (simd.h). No header is included and no
// branch is taken, so that NVRTC compiles it without a toolkit and a vector runs it in all lanes at once; choices are
// select(mask, yes, no). Constants of the paper-side conventions are in d2_plugin/protocol.py, RasterSettings.
#pragma once

#if defined(__CUDACC__)
#define D2_FN __host__ __device__ __forceinline__
#else
#define D2_FN inline __attribute__((always_inline))
#endif

namespace d2 {

#if defined(__CUDACC__)
D2_FN float fma(float a, float b, float c) { return fmaf(a, b, c); }
D2_FN float sqrt(float a) { return sqrtf(a); }
D2_FN float exp2(float a) {
#if defined(__CUDA_ARCH__)
  float power;  // exp2f takes three instructions more for powers below 2^-126: here they are 0, and no alpha that counts is one
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(power) : "f"(a));
  return power;
#else
  return exp2f(a);
#endif
}
D2_FN float log2(float a) { return log2f(a); }
#else
D2_FN float fma(float a, float b, float c) { return __builtin_fmaf(a, b, c); }
D2_FN float sqrt(float a) { return __builtin_sqrtf(a); }
D2_FN float exp2(float a) { return __builtin_exp2f(a); }
D2_FN float log2(float a) { return __builtin_log2f(a); }
#endif
D2_FN float fnma(float a, float b, float c) { return fma(-a, b, c); }
D2_FN float min(float a, float b) { return a < b ? a : b; }
D2_FN float max(float a, float b) { return a > b ? a : b; }
D2_FN float select(bool mask, float yes, float no) { return mask ? yes : no; }
D2_FN float where(bool mask, float yes) { return mask ? yes : 0.f; }
D2_FN float negative(float a) { return a < 0 ? a : -a; }  // -|a|
D2_FN float reciprocal(float a) { return 1.f / a; }

// ln 2 and the factor that turns exp(-(x^2) / 2) into 2^-((k x)^2).
constexpr float LN_2 = 0.693147180559945f, HALF_EXPONENT = 0.849321800288019f;  // sqrt(log2(e) / 2)
// Least variance on the screen where the blur is smaller, pixels squared (VARIANCE_FLOOR of reference.py).
constexpr float VARIANCE_FLOOR = 1e-8f;
// Least share of its own area in its blurred area that a Gaussian is taken to have (LEAST_AREA of reference.py).
constexpr float LEAST_AREA = 2.5e-5f;

// Plain data, laid out alike in native.py and cuda.py.
struct Camera {
  float rotation[9], translation[3];  // world to camera, row-major
  float focal_x, focal_y, center_x, center_y;
  float width, height;
};

struct Constants {  // RasterSettings
  float near, blur, alpha_max, alpha_min, transmittance_min, fov_clamp;
  float antialiased;  // 0 or 1
};

template <class S>
struct Gaussian {
  S mean[3];
  S covariance[6];  // xx xy xz yy yz zz; in a gradient: of the stored number, which stands for both places
  S opacity;
};

// A Gaussian on the screen. With (dx, dy) from its centre to a pixel's, u = ux dx + uy dy and v = vy dy,
//   log2 alpha = log2_opacity - u^2 - v^2.
// (ux, uy, vy) is the Cholesky factor of the inverse covariance: a sum of squares cannot turn negative by rounding,
// however long and thin a Gaussian is, where the usual A dx^2 + 2 B dx dy + C dy^2 does.
template <class S>
struct Footprint {
  S x, y;          // centre, pixels
  S ux, uy, vy;    // 1 / pixels
  S log2_opacity;
  S depth;         // view z
};

template <class S>
struct Reach {
  S x, y;  // half extents of the box outside of which alpha < alpha_min, pixels
};

// dL/d of a footprint as the sums over its fragments that it follows from; g = dL/d ln(alpha) of a fragment.
template <class S>
struct Moments {
  S g, gu, gv, guu, guv, gvv;
  S depth;  // sum of w dL/dz at that pixel: of the depth sum, less that of the free space in front
};

// Intermediate values of the projection that forward and backward share.
template <class S>
struct Jacobian {
  S point[3];          // in the camera
  S inverse_depth;
  S slope_x, slope_y;  // x/z and y/z clamped, where the Jacobian is taken
  S focal_x, focal_y;  // focal length over depth
  S row_x[3], row_y[3];  // gradients of the screen coordinates with respect to the world point
};

template <class S>
D2_FN S dot(const S* a, const S* b) {
  return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2]));
}

// covariance times vector
template <class S>
D2_FN void transform(const S* covariance, const S* vector, S* out) {
  const S first[3] = {covariance[0], covariance[1], covariance[2]};
  const S second[3] = {covariance[1], covariance[3], covariance[4]};
  const S third[3] = {covariance[2], covariance[4], covariance[5]};
  out[0] = dot(first, vector), out[1] = dot(second, vector), out[2] = dot(third, vector);
}

template <class S>
D2_FN S clamp(S value, float low, float high) {
  return min(max(value, S(low)), S(high));
}

// Interval of x/z (y/z) around the image centre, in which the linearisation of the projection is trusted.
struct Interval {
  float low, high;
};
D2_FN Interval trusted(float size, float focal, float center, float fov_clamp) {
  const float middle = (0.5f * size - center) / focal, half = fov_clamp * 0.5f * size / focal;
  return {middle - half, middle + half};
}

template <class S>
D2_FN Jacobian<S> linearise(const S* mean, const Camera& camera, const Constants& constants) {
  const float* R = camera.rotation;
  Jacobian<S> j;
  for (int i = 0; i < 3; i++) {
    const S row[3] = {S(R[3 * i]), S(R[3 * i + 1]), S(R[3 * i + 2])};
    j.point[i] = dot(row, mean) + S(camera.translation[i]);
  }
  j.inverse_depth = S(1.f) / j.point[2];
  const Interval x = trusted(camera.width, camera.focal_x, camera.center_x, constants.fov_clamp);
  const Interval y = trusted(camera.height, camera.focal_y, camera.center_y, constants.fov_clamp);
  j.slope_x = clamp(j.point[0] * j.inverse_depth, x.low, x.high);
  j.slope_y = clamp(j.point[1] * j.inverse_depth, y.low, y.high);
  j.focal_x = S(camera.focal_x) * j.inverse_depth;
  j.focal_y = S(camera.focal_y) * j.inverse_depth;
  for (int k = 0; k < 3; k++) {
    j.row_x[k] = j.focal_x * fnma(j.slope_x, S(R[6 + k]), S(R[k]));
    j.row_y[k] = j.focal_y * fnma(j.slope_y, S(R[6 + k]), S(R[3 + k]));
  }
  return j;
}

template <class S>
struct Projected {
  Footprint<S> footprint;
  Reach<S> reach;
  decltype(S() > S()) visible;  // in front, opaque enough, everything finite; not yet whether it touches the image
};

// What the blur does to the area of a footprint: determinants of the screen covariance without and with it. The
// difference of products cancels for thin Gaussians: beyond some thirty pixels of length it is noise above LEAST_AREA.
template <class S>
struct Area {
  S own_x, own_y, covariance;  // the screen covariance without the blur
  S own, blurred;              // determinants
  S share;                     // own / blurred, at least LEAST_AREA
};

template <class S>
D2_FN Area<S> area_of(S own_x, S own_y, S covariance, S floor) {
  Area<S> a = {own_x, own_y, covariance, fnma(covariance, covariance, own_x * own_y), S(0.f), S(0.f)};
  a.blurred = fma(floor, own_x + own_y + floor, max(a.own, S(0.f)));
  a.share = max(a.own / a.blurred, S(LEAST_AREA));
  return a;
}

// Elliptical weighted average projection (Zwicker et al. 2001). offset_x, offset_y: screen_offsets.
template <class S>
D2_FN Projected<S> project(const Gaussian<S>& g, S offset_x, S offset_y, const Camera& camera, const Constants& c) {
  const Jacobian<S> j = linearise(g.mean, camera, c);
  S along_x[3], along_y[3];
  transform(g.covariance, j.row_x, along_x);
  transform(g.covariance, j.row_y, along_y);
  const S floor = S(max(c.blur, VARIANCE_FLOOR));
  const S own_x = max(dot(j.row_x, along_x), S(0.f)), own_y = max(dot(j.row_y, along_y), S(0.f));
  const S variance_x = own_x + floor, variance_y = own_y + floor;
  const S covariance = dot(j.row_y, along_x), slope = covariance / variance_y;
  // The Schur complement is at least the blur; rounding alone can bring it below.
  const S variance_x_given_y = max(fnma(slope, covariance, variance_x), floor);

  Projected<S> out;
  Footprint<S>& f = out.footprint;
  f.x = fma(j.point[0], j.focal_x, S(camera.center_x)) + offset_x;
  f.y = fma(j.point[1], j.focal_y, S(camera.center_y)) + offset_y;
  f.ux = S(HALF_EXPONENT) / sqrt(variance_x_given_y);
  f.uy = -slope * f.ux;
  f.vy = S(HALF_EXPONENT) / sqrt(variance_y);
  f.log2_opacity = log2(max(g.opacity, S(1e-30f)));
  // The same for all Gaussians. Mip-Splatting (Yu et al. 2024): what the blur spreads it must not add.
  auto opaque = g.opacity >= S(c.alpha_min);
  if (c.antialiased != 0.f) {
    f.log2_opacity = fma(S(0.5f), log2(area_of(own_x, own_y, covariance, floor).share), f.log2_opacity);
    opaque = f.log2_opacity >= S(log2(c.alpha_min));
  }
  f.depth = j.point[2];

  const S squared = S(2.f * LN_2) * max(f.log2_opacity - S(log2(c.alpha_min)), S(0.f));
  out.reach.x = sqrt(squared * variance_x);
  out.reach.y = sqrt(squared * variance_y);
  // x - x is NaN for NaN and infinity, and NaN compares false.
  S finite = (f.x + f.y) * S(0.f) + (out.reach.x + out.reach.y) * S(0.f) + (f.uy + f.depth) * S(0.f);
  for (int k = 0; k < 3; k++) finite = finite + g.mean[k] * S(0.f);
  for (int k = 0; k < 6; k++) finite = finite + g.covariance[k] * S(0.f);
  out.visible = (f.depth > S(c.near)) & opaque & (finite + g.opacity * S(0.f) >= S(0.f));
  return out;
}

// Gradients of `project`: fills `out` and the gradient of the screen centre (= of screen_offsets).
template <class S>
D2_FN void project_backward(const Gaussian<S>& g, const Footprint<S>& f, const Moments<S>& m, const Camera& camera,
                            const Constants& c, Gaussian<S>& out, S& center_x, S& center_y) {
  const float per_unit = 2.f * LN_2;  // u^2 in units of the exponent of 2
  center_x = S(per_unit) * f.ux * m.gu;
  center_y = S(per_unit) * fma(f.uy, m.gu, f.vy * m.gv);
  // dL/d(screen covariance) = 1/2 L (sum g (u, v) (u, v)^T) L^T with L L^T the inverse: no division by a determinant.
  const S half = S(0.5f * per_unit * per_unit);
  const S uu_y = fma(f.uy, m.guu, f.vy * m.guv);
  S g_xx = half * f.ux * f.ux * m.guu;
  S g_xy = S(2.f) * half * f.ux * uu_y;  // of the stored number, which stands for both places
  S g_yy = half * fma(f.uy, uu_y, f.vy * fma(f.uy, m.guv, f.vy * m.gvv));

  const Jacobian<S> j = linearise(g.mean, camera, c);
  S along_x[3], along_y[3];
  transform(g.covariance, j.row_x, along_x);
  transform(g.covariance, j.row_y, along_y);
  if (c.antialiased != 0.f) {
    // ln alpha has 1/2 ln(own area / blurred area) in it, constant where the share is at its least.
    const S floor = S(max(c.blur, VARIANCE_FLOOR));
    const S own_x = max(dot(j.row_x, along_x), S(0.f)), own_y = max(dot(j.row_y, along_y), S(0.f));
    const Area<S> a = area_of(own_x, own_y, dot(j.row_y, along_x), floor);
    const auto free = a.share > S(LEAST_AREA);
    const S per_own = where(free, m.g / a.own), per_blurred = where(free, m.g / a.blurred);
    g_xx = fma(S(0.5f), fnma(per_blurred, a.own_y + floor, per_own * a.own_y), g_xx);
    g_yy = fma(S(0.5f), fnma(per_blurred, a.own_x + floor, per_own * a.own_x), g_yy);
    g_xy = fnma(a.covariance, per_own - per_blurred, g_xy);
  }
  for (int a = 0, entry = 0; a < 3; a++)
    for (int b = a; b < 3; b++, entry++) {
      const S cross = fma(j.row_x[a], j.row_y[b], j.row_x[b] * j.row_y[a]);
      const S value = fma(g_xx * j.row_x[a], j.row_x[b], fma(g_yy * j.row_y[a], j.row_y[b], S(0.5f) * g_xy * cross));
      out.covariance[entry] = a == b ? value : S(2.f) * value;
    }
  out.opacity = m.g / g.opacity;

  S row_x[3], row_y[3];
  for (int k = 0; k < 3; k++) {
    row_x[k] = fma(S(2.f) * g_xx, along_x[k], g_xy * along_y[k]);
    row_y[k] = fma(S(2.f) * g_yy, along_y[k], g_xy * along_x[k]);
  }
  // row_x = focal / z (R_0 - slope_x R_2), and the slope depends on the point only where it is not clamped.
  const float* R = camera.rotation;
  const S forward[3] = {S(R[6]), S(R[7]), S(R[8])};
  const S slope_x = -j.focal_x * dot(row_x, forward), slope_y = -j.focal_y * dot(row_y, forward);
  const S ratio_x = j.point[0] * j.inverse_depth, ratio_y = j.point[1] * j.inverse_depth;
  const S free_x = where((ratio_x >= j.slope_x) & (ratio_x <= j.slope_x), slope_x * j.inverse_depth);
  const S free_y = where((ratio_y >= j.slope_y) & (ratio_y <= j.slope_y), slope_y * j.inverse_depth);
  S point[3];
  point[0] = fma(center_x, j.focal_x, free_x);
  point[1] = fma(center_y, j.focal_y, free_y);
  // Everything that carries focal / z: the rows themselves and the screen centre.
  const S scaled = dot(row_x, j.row_x) + dot(row_y, j.row_y) +
                   fma(center_x * j.focal_x, j.point[0], center_y * j.focal_y * j.point[1]);
  point[2] = m.depth - j.inverse_depth * scaled - fma(free_x, j.slope_x, free_y * j.slope_y);
  for (int k = 0; k < 3; k++) {
    const S column[3] = {S(R[k]), S(R[3 + k]), S(R[6 + k])};
    out.mean[k] = dot(column, point);
  }
}

// One Gaussian at one pixel (or at one block of pixels).
template <class S>
struct Fragment {
  S u, v;
  S log2_alpha;  // before the clamp to alpha_max
};

template <class S>
D2_FN Fragment<S> fragment(float log2_opacity, S u, S v) {
  return {u, v, fnma(u, u, fnma(v, v, S(log2_opacity)))};
}

// u and v at (dx, dy) pixels from the centre.
template <class S>
D2_FN S along_u(const Footprint<float>& f, S dx, S dy) {
  return fma(S(f.ux), dx, S(f.uy) * dy);
}
template <class S>
D2_FN S along_v(const Footprint<float>& f, S dy) {
  return S(f.vy) * dy;
}

// The space that the depth prior says is free at a pixel: nearer than `near`, the near edge D_near of what the prior
// allows. `scale` is 1 / D_near, or dL/d(front) / D_near. Both are 0 where nothing is known.
template <class S>
struct FreeSpace {
  S near, scale;
};

// `near` may be anything, NaN included; below LEAST_EDGE it has no finite inverse to rely on.
constexpr float LEAST_EDGE = 1e-30f;  // of reference.py, too
template <class S>
D2_FN FreeSpace<S> free_space(S near) {
  const auto known = (near > S(LEAST_EDGE)) & (near * S(0.f) >= S(0.f));
  return {where(known, near), where(known, S(1.f) / near)};
}

// max(0, D_near - z), and max(0, 1 - z / D_near) from it: by the difference both are exactly 0 at the edge.
template <class S>
D2_FN S before_edge(S near, S depth) {
  return max(near - depth, S(0.f));
}
template <class S>
D2_FN S in_front(const FreeSpace<S>& space, S depth) {
  return before_edge(space.near, depth) * space.scale;
}

// The same differentiated by -z; 0 at the edge.
template <class S>
D2_FN S in_front_gradient(const FreeSpace<S>& space, S depth) {
  return where(space.near > depth, space.scale);
}

// One step of front-to-back compositing. A finished pixel carries its transmittance negated (or 0: the CPU's choice).
template <class S>
struct Step {
  decltype(S() > S()) seen, open;  // reaches alpha_min; and the pixel is not finished, by this Gaussian or before
  S alpha, weight;                 // alpha is 0 where not seen, weight where not seen or not open
  S after;                         // transmittance behind the Gaussian if it is open
  S transmittance;                 // the same, or where it is not open that in front, negated
};

template <class S>
D2_FN Step<S> composite(S log2_alpha, S transmittance, float log2_alpha_min, const Constants& c) {
  Step<S> s;
  s.seen = log2_alpha >= S(log2_alpha_min);
  s.alpha = where(s.seen, min(exp2(log2_alpha), S(c.alpha_max)));
  s.after = fnma(s.alpha, transmittance, transmittance);
  s.open = s.after > S(c.transmittance_min);
  s.weight = where(s.open, s.alpha * transmittance);
  s.transmittance = select(s.open, s.after, negative(transmittance));
  return s;
}

// dL/d ln(alpha) of a fragment: `value` is dL/dw, `behind` the sum of w dL/dw over everything behind it. Front to back,
// `behind` is what remains of the pixel's total; no gradient flows through a clamped alpha.
template <class S>
D2_FN S log_alpha_gradient(const Step<S>& s, S log2_alpha, S transmittance, S value, S behind, float log2_alpha_max) {
  const S gradient = fnma(behind, reciprocal(S(1.f) - s.alpha), value * transmittance);
  return where(s.open & (log2_alpha <= S(log2_alpha_max)), s.alpha * gradient);
}

}  // namespace d2
