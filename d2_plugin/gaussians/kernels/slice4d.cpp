// Gaussians of a 4D model at an instant, forward and backward: what `reference_slice` of slicing.py does in torch.
//
// LANES Gaussians at a time, one per lane; rows of the parameters are turned into columns on the way in and back on the
// way out. Nothing is saved between the passes: computing a Gaussian again is cheaper than reading it from memory.
// Each Gaussian is computed by itself, so results are the same bits for any number of threads.
#include <algorithm>
#include <cfloat>
#include <cstdint>
#include <cstring>
#include <vector>

#include "parallel.h"
#include "simd.h"

namespace d2 {

// What one call works on, as native_slice.py fills it in. A model without time has neither times nor `right`.
struct Slice {
  int64_t count, drawn;  // N Gaussians, M of them at this instant
  float time, marginal_cut, log_scale_limit, small_norm;
  int32_t threads;

  const float *positions, *log_scales, *left, *opacity_logits;  // [N, 3], [N, 3], [N, 4], [N]
  const float *times, *log_time_scales, *right;                 // [N], [N], [N, 4] or null
  int64_t* rows;                                                // [N], then the first M are the rows drawn
  float *means, *covariances, *opacities;                       // [M, 3], [M, 6], [M]

  const float *grad_means, *grad_covariances, *grad_opacities;  // null where nothing comes back
  float *grad_positions, *grad_log_scales, *grad_left, *grad_opacity_logits;
  float *grad_times, *grad_log_time_scales, *grad_right;
};

constexpr int64_t CHUNK = 1024;  // Gaussians of one task, a multiple of LANES; some 20 microseconds of work

// ------------------------------------------------------------------------------------------- rows and columns

// Up to LANES rows of the arrays; a lane without one repeats the last, and is not stored.
struct Group {
  int64_t row[LANES];
  int count;
  bool together;  // consecutive rows, one per lane: no need to collect them

  Group(const int64_t* index, int64_t first, int64_t end) : count(int(std::min<int64_t>(LANES, end - first))) {
    for (int i = 0; i < LANES; i++) {
      const int64_t at = first + std::min(i, count - 1);
      row[i] = index ? index[at] : at;
    }
    together = count == LANES && row[LANES - 1] - row[0] == LANES - 1;  // rows only ever increase
  }
};

// Columns of an array [., K]; zeros where there is no array.
template <int K>
D2_INLINE void load(const Group& group, const float* array, Floats* columns) {
  alignas(64) float collected[LANES * K];
  const float* from = collected;
  if (!array)
    std::fill(collected, collected + LANES * K, 0.f);
  else if (group.together)
    from = array + K * group.row[0];
  else
    for (int i = 0; i < LANES; i++) std::memcpy(collected + K * i, array + K * group.row[i], sizeof(float) * K);
  load_rows<K>(from, columns);
}

template <int K>
D2_INLINE void store(const Group& group, const Floats* columns, float* array) {
  alignas(64) float collected[LANES * K];
  float* to = group.together ? array + K * group.row[0] : collected;
  store_rows<K>(columns, to);
  if (group.together) return;
  for (int i = 0; i < group.count; i++) std::memcpy(array + K * group.row[i], collected + K * i, sizeof(float) * K);
}

// ------------------------------------------------------------------------------------------- functions

// e^x for |x| <= 87: Cephes' polynomial on |x| <= ln 2 / 2, exactly 1 at 0. Adding 1.5 * 2^23 rounds to an integer and
// leaves it in the low bits, to be shifted into the exponent; x - x keeps a NaN a NaN.
D2_INLINE Floats exp(Floats x) {
  const Floats magic = 12582912.f, shifted = fma(x, Floats(1.44269504f), magic), whole = shifted - magic;
  const Floats part = fnma(whole, Floats(-2.12194440e-4f), fnma(whole, Floats(0.693359375f), x));
  Floats p = fma(part, Floats(1.9875691500e-4f), Floats(1.3981999507e-3f));
  p = fma(p, part, Floats(8.3334519073e-3f));
  p = fma(p, part, Floats(4.1665795894e-2f));
  p = fma(p, part, Floats(1.6666665459e-1f));
  p = fma(p, part, Floats(5.0000001201e-1f));
  p = fma(p, part * part, part) + Floats(1.f);
  const Floats scaled = Native(Integers(p.v) + (Integers(shifted.v) << 23));
  return scaled + (x - x);
}

// min and max return their second argument where one is NaN: a NaN stays one.
D2_INLINE Floats clamp(Floats x, float limit) { return min(Floats(limit), max(Floats(-limit), x)); }

// sigmoid(x) and sigmoid(-x), both to full relative precision.
D2_INLINE void sigmoids(Floats x, Floats& positive, Floats& negative) {
  const Floats decay = exp(Floats(0.f) - min(Floats(87.f), abs(x)));
  const Floats larger = Floats(1.f) / (Floats(1.f) + decay), smaller = decay * larger;
  const Mask right = x >= Floats(0.f);
  positive = select(right, larger, smaller);
  negative = select(right, smaller, larger);
}

// A quaternion of length one; the identity, through which no gradient flows, for one that has no direction.
struct Unit {
  Floats q[4], inverse_norm;
};

D2_INLINE Unit normalized(const Floats* raw, float small_norm) {
  Floats largest = abs(raw[0]);
  Mask ok = largest <= Floats(FLT_MAX);  // not so for NaN
  for (int k = 1; k < 4; k++) {
    largest = max(largest, abs(raw[k]));
    ok = ok & (abs(raw[k]) <= Floats(FLT_MAX));
  }
  ok = ok & (largest > Floats(small_norm));
  largest = select(ok, largest, Floats(1.f));
  const Floats shrink = Floats(1.f) / largest;  // keeps the squares inside the range of float32
  Unit unit;
  for (int k = 0; k < 4; k++) unit.q[k] = select(ok, raw[k] * shrink, Floats(k == 0 ? 1.f : 0.f));
  const Floats* q = unit.q;
  const Floats inverse = Floats(1.f) / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  for (int k = 0; k < 4; k++) unit.q[k] = unit.q[k] * inverse;
  unit.inverse_norm = where(ok, inverse * shrink);
  return unit;
}

// Gradient of the raw quaternion from that of the unit one: what points along it is lost, the rest divided by the norm.
D2_INLINE void normalized_backward(const Unit& u, const Floats* grad, Floats* grad_raw) {
  const Floats along = u.q[0] * grad[0] + u.q[1] * grad[1] + u.q[2] * grad[2] + u.q[3] * grad[3];
  const Mask ok = u.inverse_norm > Floats(0.f);
  for (int k = 0; k < 4; k++) grad_raw[k] = where(ok, (grad[k] - u.q[k] * along) * u.inverse_norm);
}

// J M_l and M_r J, whose product is the 4D rotation (rotation4d.py).
D2_INLINE void left_matrix(const Floats* q, Floats m[4][4]) {
  const Floats a = q[0], b = q[1], c = q[2], d = q[3];
  m[0][0] = d, m[0][1] = -c, m[0][2] = b, m[0][3] = a;
  m[1][0] = c, m[1][1] = d, m[1][2] = a, m[1][3] = -b;
  m[2][0] = b, m[2][1] = a, m[2][2] = -d, m[2][3] = c;
  m[3][0] = a, m[3][1] = -b, m[3][2] = -c, m[3][3] = -d;
}

D2_INLINE void left_matrix_backward(const Floats m[4][4], Floats* grad) {
  grad[0] = m[0][3] + m[1][2] + m[2][1] + m[3][0];
  grad[1] = m[0][2] - m[1][3] + m[2][0] - m[3][1];
  grad[2] = m[1][0] - m[0][1] + m[2][3] - m[3][2];
  grad[3] = m[0][0] + m[1][1] - m[2][2] - m[3][3];
}

D2_INLINE void right_matrix(const Floats* quaternion, Floats m[4][4]) {
  const Floats p = quaternion[0], q = quaternion[1], r = quaternion[2], s = quaternion[3];
  m[0][0] = s, m[0][1] = r, m[0][2] = q, m[0][3] = p;
  m[1][0] = r, m[1][1] = -s, m[1][2] = p, m[1][3] = -q;
  m[2][0] = -q, m[2][1] = p, m[2][2] = s, m[2][3] = -r;
  m[3][0] = p, m[3][1] = q, m[3][2] = -r, m[3][3] = -s;
}

D2_INLINE void right_matrix_backward(const Floats m[4][4], Floats* grad) {
  grad[0] = m[0][3] + m[1][2] + m[2][1] + m[3][0];
  grad[1] = m[0][2] - m[1][3] - m[2][0] + m[3][1];
  grad[2] = m[0][1] + m[1][0] - m[2][3] - m[3][2];
  grad[3] = m[0][0] - m[1][1] + m[2][2] - m[3][3];
}

D2_INLINE void rotation_3d(const Floats* q, Floats m[3][3]) {
  const Floats w = q[0], x = q[1], y = q[2], z = q[3], one = 1.f, two = 2.f;
  m[0][0] = one - two * (y * y + z * z), m[0][1] = two * (x * y - w * z), m[0][2] = two * (x * z + w * y);
  m[1][0] = two * (x * y + w * z), m[1][1] = one - two * (x * x + z * z), m[1][2] = two * (y * z - w * x);
  m[2][0] = two * (x * z - w * y), m[2][1] = two * (y * z + w * x), m[2][2] = one - two * (x * x + y * y);
}

D2_INLINE void rotation_3d_backward(const Floats* q, const Floats m[3][3], Floats* grad) {
  const Floats w = q[0], x = q[1], y = q[2], z = q[3], two = 2.f;
  const Floats odd_x = m[2][1] - m[1][2], odd_y = m[0][2] - m[2][0], odd_z = m[1][0] - m[0][1];
  const Floats even_x = m[2][1] + m[1][2], even_y = m[0][2] + m[2][0], even_z = m[1][0] + m[0][1];
  grad[0] = two * (x * odd_x + y * odd_y + z * odd_z);
  grad[1] = two * (w * odd_x + y * even_z + z * even_y - two * x * (m[1][1] + m[2][2]));
  grad[2] = two * (w * odd_y + x * even_z + z * even_x - two * y * (m[0][0] + m[2][2]));
  grad[3] = two * (w * odd_z + x * even_y + y * even_x - two * z * (m[0][0] + m[1][1]));
}

// ------------------------------------------------------------------------------------------- the slice

// K scales: three, or four with time.
template <int K>
struct Scales {
  Floats raw[K], value[K];
};

template <int K>
D2_INLINE Scales<K> load_scales(const Slice& s, const Group& group) {
  Scales<K> scales;
  load<3>(group, s.log_scales, scales.raw);
  if (K == 4) load<1>(group, s.log_time_scales, scales.raw + K - 1);
  for (int k = 0; k < K; k++) scales.value[k] = exp(clamp(scales.raw[k], s.log_scale_limit));
  return scales;
}

D2_INLINE Unit load_quaternions(const Slice& s, const Group& group, const float* array) {
  Floats raw[4];
  load<4>(group, array, raw);
  return normalized(raw, s.small_norm);
}

D2_INLINE Floats dot4(const Floats* a, const Floats* b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
}

// F(t) = exp(-offset^2 / (2 variance)); 1 at offset 0.
D2_INLINE Floats temporal_marginal(Floats offset, Floats variance) {
  return exp(max(Floats(-80.f), Floats(-0.5f) * offset * (offset / variance)));
}

// A 4D Gaussian as its factor L = R diag(scales) of Sigma = L L^T, and its conditional given time: the Householder
// reflection H = I - beta axis axis^T brings the last row of L to (0, 0, 0, l); then L H = [[A, w], [0, l]].
struct Conditional {
  Scales<4> scales;
  Unit left, right;
  Floats j_left[4][4], right_j[4][4], rotation[4][4], factor[4][4];
  Floats offset, variance, marginal;
  Floats axis[4], beta, spatial[3][3], velocity[3];

  D2_INLINE Conditional(const Slice& s, const Group& group) {
    scales = load_scales<4>(s, group);
    left = load_quaternions(s, group, s.left);
    right = load_quaternions(s, group, s.right);
    left_matrix(left.q, j_left);
    right_matrix(right.q, right_j);
    for (int i = 0; i < 4; i++)
      for (int k = 0; k < 4; k++) {
        rotation[i][k] = j_left[i][0] * right_j[0][k] + j_left[i][1] * right_j[1][k] + j_left[i][2] * right_j[2][k] +
                         j_left[i][3] * right_j[3][k];
        factor[i][k] = rotation[i][k] * scales.value[k];
      }
    load<1>(group, s.times, &offset);
    offset = Floats(s.time) - offset;
    variance = dot4(factor[3], factor[3]);
    marginal = temporal_marginal(offset, variance);
    condition();
  }

  D2_INLINE void condition() {
    const Floats inverse = Floats(1.f) / sqrt(variance);
    for (int k = 0; k < 4; k++) axis[k] = factor[3][k] * inverse;
    const Floats sign = select(axis[3] >= Floats(0.f), Floats(1.f), Floats(-1.f));
    beta = Floats(1.f) / (Floats(1.f) + axis[3] * sign);
    for (int i = 0; i < 3; i++) velocity[i] = dot4(factor[i], axis) * inverse;
    axis[3] = axis[3] + sign;  // no cancellation: the signs agree
    for (int i = 0; i < 3; i++) {
      const Floats along = dot4(factor[i], axis) * beta;
      for (int k = 0; k < 3; k++) spatial[i][k] = factor[i][k] - along * axis[k];
    }
  }
};

// Without time: A = R diag(scales).
struct Static {
  Scales<3> scales;
  Unit left;
  Floats rotation[3][3], spatial[3][3];

  D2_INLINE Static(const Slice& s, const Group& group) {
    scales = load_scales<3>(s, group);
    left = load_quaternions(s, group, s.left);
    rotation_3d(left.q, rotation);
    for (int i = 0; i < 3; i++)
      for (int k = 0; k < 3; k++) spatial[i][k] = rotation[i][k] * scales.value[k];
  }
};

// Covariance xx xy xz yy yz zz of a factor A.
D2_INLINE void covariance(const Floats a[3][3], Floats* out) {
  for (int i = 0; i < 3; i++)
    for (int j = i; j < 3; j++) *out++ = a[i][0] * a[j][0] + a[i][1] * a[j][1] + a[i][2] * a[j][2];
}

// Gradient of a factor A [3, K] from that of its covariance, whose off-diagonal numbers stand for two entries each.
template <int K>
D2_INLINE void covariance_backward(const Floats* g, const Floats a[3][K], Floats grad[3][K]) {
  const Floats two = 2.f;
  for (int k = 0; k < K; k++) {
    grad[0][k] = two * g[0] * a[0][k] + g[1] * a[1][k] + g[2] * a[2][k];
    grad[1][k] = g[1] * a[0][k] + two * g[3] * a[1][k] + g[4] * a[2][k];
    grad[2][k] = g[2] * a[0][k] + g[4] * a[1][k] + two * g[5] * a[2][k];
  }
}

// The gradient of log-scales does not pass the clamp.
template <int K>
D2_INLINE void store_log_scales(const Slice& s, const Group& group, const Scales<K>& scales, Floats* grad) {
  for (int k = 0; k < K; k++) grad[k] = where(abs(scales.raw[k]) <= Floats(s.log_scale_limit), grad[k]);
  store<3>(group, grad, s.grad_log_scales);
  if (K == 4) store<1>(group, grad + K - 1, s.grad_log_time_scales);
}

static void forward_group(const Slice& s, const Group& in, const Group& out) {
  Floats logit, opacity, rest, means[3], covariances[6];
  load<1>(in, s.opacity_logits, &logit);
  load<3>(in, s.positions, means);
  sigmoids(logit, opacity, rest);
  if (s.times) {
    const Conditional gaussian(s, in);
    covariance(gaussian.spatial, covariances);
    opacity = opacity * gaussian.marginal;
    for (int i = 0; i < 3; i++) means[i] = means[i] + gaussian.velocity[i] * gaussian.offset;
  } else {
    covariance(Static(s, in).spatial, covariances);
  }
  store<3>(out, means, s.means);
  store<6>(out, covariances, s.covariances);
  store<1>(out, &opacity, s.opacities);
}

// What comes back to a group.
struct Incoming {
  Floats means[3], covariances[6], opacity;
  D2_INLINE Incoming(const Slice& s, const Group& out) {
    load<3>(out, s.grad_means, means);
    load<6>(out, s.grad_covariances, covariances);
    load<1>(out, s.grad_opacities, &opacity);
  }
};

static void backward_static(const Slice& s, const Group& in, const Incoming& g) {
  const Static gaussian(s, in);
  Floats grad[3][3], grad_scales[3] = {0.f, 0.f, 0.f}, grad_unit[4], grad_left[4];
  covariance_backward<3>(g.covariances, gaussian.spatial, grad);
  for (int i = 0; i < 3; i++)
    for (int k = 0; k < 3; k++) {
      grad_scales[k] = grad_scales[k] + grad[i][k] * gaussian.spatial[i][k];
      grad[i][k] = grad[i][k] * gaussian.scales.value[k];
    }
  rotation_3d_backward(gaussian.left.q, grad, grad_unit);
  normalized_backward(gaussian.left, grad_unit, grad_left);
  store_log_scales(s, in, gaussian.scales, grad_scales);
  store<4>(in, grad_left, s.grad_left);
}

// Gradients of factor, log-scales and time. Sigma_cond = B B^T with B = [A, 0] H, the part of the factor's rows across
// the last one; velocity = L_i . L_3 / variance.
struct ConditionalGradient {
  Floats factor[4][4], log_scales[4], time;

  D2_INLINE ConditionalGradient(const Conditional& c, const Incoming& g, Floats grad_marginal) {
    Floats across[3][4];
    for (int i = 0; i < 3; i++) {
      const Floats along =
          (c.spatial[i][0] * c.axis[0] + c.spatial[i][1] * c.axis[1] + c.spatial[i][2] * c.axis[2]) * c.beta;
      for (int k = 0; k < 3; k++) across[i][k] = c.spatial[i][k] - along * c.axis[k];
      across[i][3] = -along * c.axis[3];
    }
    covariance_backward<4>(g.covariances, across, factor);
    // Ratios first: the square of a small variance would vanish in float32.
    const Floats ratio = c.offset / c.variance, on_exponent = grad_marginal * c.marginal;
    for (int k = 0; k < 4; k++) {
      const Floats last = ratio * c.factor[3][k];
      factor[3][k] = on_exponent * ratio * last;
      log_scales[k] = on_exponent * last * last;
      for (int i = 0; i < 3; i++) {
        const Floats pull = g.means[i] * last;
        // Row by row, sum of factor * gradient: what is large in the last row cancels against the others, so they are
        // taken together.
        log_scales[k] = log_scales[k] + across[i][k] * (factor[i][k] + pull + pull);
        factor[i][k] = factor[i][k] + pull;
        factor[3][k] = factor[3][k] + g.means[i] * ratio * across[i][k] - c.velocity[i] * factor[i][k];
      }
    }
    time = on_exponent * ratio -
           (g.means[0] * c.velocity[0] + g.means[1] * c.velocity[1] + g.means[2] * c.velocity[2]);
  }
};

static void backward_temporal(const Slice& s, const Group& in, const Incoming& g, Floats opacity, Floats rest) {
  const Conditional c(s, in);
  ConditionalGradient grad(c, g, g.opacity * opacity);
  const Floats grad_logit = g.opacity * c.marginal * opacity * rest;
  for (int i = 0; i < 4; i++)
    for (int k = 0; k < 4; k++) grad.factor[i][k] = grad.factor[i][k] * c.scales.value[k];  // now of the rotation
  Floats on_left[4][4], on_right[4][4], grad_unit[4], grad_left[4], grad_right[4];
  for (int i = 0; i < 4; i++)
    for (int j = 0; j < 4; j++) {
      on_left[i][j] = dot4(grad.factor[i], c.right_j[j]);
      on_right[i][j] = c.j_left[0][i] * grad.factor[0][j] + c.j_left[1][i] * grad.factor[1][j] +
                       c.j_left[2][i] * grad.factor[2][j] + c.j_left[3][i] * grad.factor[3][j];
    }
  left_matrix_backward(on_left, grad_unit);
  normalized_backward(c.left, grad_unit, grad_left);
  right_matrix_backward(on_right, grad_unit);
  normalized_backward(c.right, grad_unit, grad_right);
  store_log_scales(s, in, c.scales, grad.log_scales);
  store<4>(in, grad_left, s.grad_left);
  store<4>(in, grad_right, s.grad_right);
  store<1>(in, &grad.time, s.grad_times);
  store<1>(in, &grad_logit, s.grad_opacity_logits);
}

static void backward_group(const Slice& s, const Group& in, const Group& out) {
  const Incoming g(s, out);
  Floats logit, opacity, rest;
  load<1>(in, s.opacity_logits, &logit);
  sigmoids(logit, opacity, rest);
  store<3>(in, g.means, s.grad_positions);
  if (s.times) return backward_temporal(s, in, g, opacity, rest);
  const Floats grad_logit = g.opacity * opacity * rest;
  store<1>(in, &grad_logit, s.grad_opacity_logits);
  backward_static(s, in, g);
}

// Writes the rows among first..end-1 whose marginal is above the cut to `rows`; returns their number. The last row of
// the rotation is enough for the variance.
static int64_t find_drawn(const Slice& s, int64_t first, int64_t end, int64_t* rows) {
  int64_t found = 0;
  for (; first < end; first += LANES) {
    const Group group(nullptr, first, end);
    const Scales<4> scales = load_scales<4>(s, group);
    const Unit left = load_quaternions(s, group, s.left), right = load_quaternions(s, group, s.right);
    Floats right_j[4][4], row[4], offset;
    right_matrix(right.q, right_j);
    const Floats j_left[4] = {left.q[0], -left.q[1], -left.q[2], -left.q[3]};
    for (int k = 0; k < 4; k++) {
      row[k] = j_left[0] * right_j[0][k] + j_left[1] * right_j[1][k] + j_left[2] * right_j[2][k] +
               j_left[3] * right_j[3][k];
      row[k] = row[k] * scales.value[k];
    }
    load<1>(group, s.times, &offset);
    const Floats marginal = temporal_marginal(Floats(s.time) - offset, dot4(row, row));
    const unsigned drawn = lanes(marginal > Floats(s.marginal_cut));
    for (int i = 0; i < group.count; i++) {  // without a branch, which could not be predicted
      rows[found] = first + i;
      found += drawn >> i & 1;
    }
  }
  return found;
}

// Zeros the gradients of the rows begin..end-1.
static void clear(const Slice& s, int64_t begin, int64_t end) {
  float* const arrays[] = {s.grad_positions, s.grad_log_scales,      s.grad_left, s.grad_opacity_logits,
                           s.grad_times,     s.grad_log_time_scales, s.grad_right};
  const int64_t widths[] = {3, 3, 4, 1, 1, 1, 4};
  for (int i = 0; i < 7; i++)
    if (arrays[i]) std::fill(arrays[i] + widths[i] * begin, arrays[i] + widths[i] * end, 0.f);
}

template <class Body>
static void for_each_chunk(const Slice& s, int64_t count, Body body) {
  parallel_for(s.threads, (count + CHUNK - 1) / CHUNK,
               [&](int64_t chunk) { body(chunk * CHUNK, std::min(count, (chunk + 1) * CHUNK)); });
}

}  // namespace d2

// ------------------------------------------------------------------------------------------- C ABI

using d2::Group;
using d2::Slice;

extern "C" {

int64_t d2_slice4d_size() { return sizeof(Slice); }

// Step 1: the rows that are drawn, in order; returns M.
int64_t d2_slice_rows(const Slice* s) {
  std::vector<int64_t> found_in(size_t(s->count / d2::CHUNK + 1));
  d2::for_each_chunk(*s, s->count, [&](int64_t first, int64_t end) {
    found_in[first / d2::CHUNK] = d2::find_drawn(*s, first, end, s->rows + first);
  });
  int64_t drawn = 0;
  for (int64_t first = 0; first < s->count; first += d2::CHUNK) {
    const int64_t found = found_in[first / d2::CHUNK];
    std::memmove(s->rows + drawn, s->rows + first, sizeof(int64_t) * found);
    drawn += found;
  }
  return drawn;
}

// Step 2: means, covariances and opacities of the rows.
void d2_slice_forward(const Slice* s) {
  d2::for_each_chunk(*s, s->drawn, [&](int64_t first, int64_t end) {
    for (; first < end; first += d2::LANES)
      d2::forward_group(*s, Group(s->rows, first, end), Group(nullptr, first, end));
  });
}

// Gradients of the parameters; zero for rows that are not drawn.
void d2_slice_backward(const Slice* s) {
  const bool gaps = s->drawn < s->count;
  if (s->drawn == 0) d2::clear(*s, 0, s->count);
  d2::for_each_chunk(*s, s->drawn, [&](int64_t first, int64_t end) {
    if (gaps) d2::clear(*s, first ? s->rows[first] : 0, end < s->drawn ? s->rows[end] : s->count);
    for (; first < end; first += d2::LANES)
      d2::backward_group(*s, Group(s->rows, first, end), Group(nullptr, first, end));
  });
}
}
