// Sums over the points of the Charbonnier fit (points.py), all of one iterate in one pass.
//
// Sums run along eight lanes that are added up at the end: the same bits on every machine, and always one thread.
#include <cstdint>

namespace d2 {

// Mirrored by `_Sums` in points.py: min over a, b of sum rho(a p + b q - t), with r the residual and u = rho'(r).
struct Sums {
  int64_t count;
  double a, b, epsilon;
  const double *p, *q, *t;  // [count]
  double* sums;             // [15], in the order of `points.Sums`
};

// Mirrored by `_Duals` in points.py: u moved into the feasible set, once by those that have room and once by all.
struct Duals {
  int64_t count;
  double a, b, epsilon;
  const double *p, *q, *t;  // [count]
  double steps[4];          // what u is moved by, in units of p and of q: by 1 - u^2, and by 1
  double shrink[2];         // and then divided by
  double* sums;             // [2, 3]: see `points.Dual`
};

namespace {

constexpr int LANES = 8;

// Call point(lane, p, q, t) for every point. Lanes behind the last one see zeros, which add nothing to any sum.
template <class Call, class Point>
inline __attribute__((always_inline)) void each(const Call& call, Point point) {
  int64_t i = 0;
  for (; i + LANES <= call.count; i += LANES)
    for (int l = 0; l < LANES; l++) point(l, call.p[i + l], call.q[i + l], call.t[i + l]);
  if (i == call.count) return;
  double p[LANES] = {}, q[LANES] = {}, t[LANES] = {};
  for (int l = 0; i + l < call.count; l++) p[l] = call.p[i + l], q[l] = call.q[i + l], t[l] = call.t[i + l];
  for (int l = 0; l < LANES; l++) point(l, p[l], q[l], t[l]);
}

double together(const double (&lanes)[LANES]) {
  return ((lanes[0] + lanes[1]) + (lanes[2] + lanes[3])) + ((lanes[4] + lanes[5]) + (lanes[6] + lanes[7]));
}

}  // namespace
}  // namespace d2

extern "C" int64_t d2_sums_size() { return sizeof(d2::Sums); }
extern "C" int64_t d2_duals_size() { return sizeof(d2::Duals); }

extern "C" void d2_sums(const d2::Sums* given) {
  using namespace d2;
  const Sums call = *given;
  const double square = call.epsilon * call.epsilon;
  double sum[15][LANES] = {};
  each(call, [&](int l, double p, double q, double t) __attribute__((always_inline)) {
    const double r = call.a * p + call.b * q - t, inverse = 1 / __builtin_sqrt(r * r + square), u = r * inverse;
    const double sharp = call.epsilon * inverse, newton = inverse * (sharp * sharp), spread = u * u, room = 1 - spread;
    const double pp = p * p, pq = p * q, qq = q * q;
    sum[0][l] += r * (u / (1 + sharp));
    sum[1][l] += p * u, sum[2][l] += q * u;
    sum[3][l] += inverse * pp, sum[4][l] += inverse * pq, sum[5][l] += inverse * qq;
    sum[6][l] += newton * pp, sum[7][l] += newton * pq, sum[8][l] += newton * qq;
    sum[9][l] += room * pp, sum[10][l] += room * pq, sum[11][l] += room * qq;
    sum[12][l] += spread * pp, sum[13][l] += spread * pq, sum[14][l] += spread * qq;
  });
  for (int n = 0; n < 15; n++) call.sums[n] = together(sum[n]);
}

extern "C" void d2_duals(const d2::Duals* given) {
  using namespace d2;
  const Duals call = *given;
  const double square = call.epsilon * call.epsilon;
  double largest[2][LANES] = {}, product[2][LANES] = {}, conjugate[2][LANES] = {};
  each(call, [&](int l, double p, double q, double t) __attribute__((always_inline)) {
    const double r = call.a * p + call.b * q - t, u = r * (1 / __builtin_sqrt(r * r + square)), room[2] = {1 - u * u, 1};
    for (int n = 0; n < 2; n++) {
      const double moved = u - room[n] * (call.steps[2 * n] * p + call.steps[2 * n + 1] * q), size = __builtin_fabs(moved);
      const double feasible = moved / call.shrink[n];
      const double whole = feasible * feasible, part = whole < 1 ? whole : 1;
      largest[n][l] = size > largest[n][l] ? size : largest[n][l];
      product[n][l] += feasible * t;
      conjugate[n][l] += part / (1 + __builtin_sqrt(1 - part));
    }
  });
  for (int n = 0; n < 2; n++) {
    double most = 0;
    for (int l = 0; l < LANES; l++) most = largest[n][l] > most ? largest[n][l] : most;
    call.sums[3 * n] = most;
    call.sums[3 * n + 1] = together(product[n]), call.sums[3 * n + 2] = together(conjugate[n]);
  }
}
