// One vector of floats and its comparison mask, for AVX-512 (16 lanes), AVX2 (8) and anything else (4, through the
// vector extension of GCC and Clang). Loops over pixels and Gaussians are written once on top of it.
//
// Fused multiply-adds are written out and the build forbids the compiler to contract others, so that the same formula
// gives the same bits wherever it is inlined: the backward pass replays the decisions of the forward pass.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__AVX512F__) && defined(__AVX512DQ__) && defined(__AVX512VL__)
#define D2_AVX512 1
#include <immintrin.h>
#elif defined(__AVX2__) && defined(__FMA__)
#define D2_AVX2 1
#include <immintrin.h>
#endif

#define D2_INLINE inline __attribute__((always_inline))
#define D2_FLAT __attribute__((always_inline))  // of a lambda

namespace d2 {

#if defined(D2_AVX512)
constexpr int LANES = 16, BLOCK_WIDTH = 4, BLOCK_HEIGHT = 4;
typedef __m512 Native;
#elif defined(D2_AVX2)
constexpr int LANES = 8, BLOCK_WIDTH = 4, BLOCK_HEIGHT = 2;
typedef __m256 Native;
#else
constexpr int LANES = 4, BLOCK_WIDTH = 2, BLOCK_HEIGHT = 2;
typedef float Native __attribute__((vector_size(16)));
#endif

typedef int32_t Integers __attribute__((vector_size(4 * LANES)));

struct Floats {
  Native v;
  Floats() = default;
  D2_INLINE Floats(Native native) : v(native) {}
  D2_INLINE Floats(float value) {
#if defined(D2_AVX512)
    v = _mm512_set1_ps(value);
#elif defined(D2_AVX2)
    v = _mm256_set1_ps(value);
#else
    v = Native{value, value, value, value};
#endif
  }
  static D2_INLINE Floats load(const float* from) {
    Floats out;
    std::memcpy(&out.v, from, sizeof(Native));
    return out;
  }
  D2_INLINE void store(float* to) const { std::memcpy(to, &v, sizeof(Native)); }
};

D2_INLINE Floats operator+(Floats a, Floats b) { return a.v + b.v; }
D2_INLINE Floats operator-(Floats a, Floats b) { return a.v - b.v; }
D2_INLINE Floats operator*(Floats a, Floats b) { return a.v * b.v; }
D2_INLINE Floats operator/(Floats a, Floats b) { return a.v / b.v; }
D2_INLINE Floats operator-(Floats a) { return -a.v; }

#if defined(D2_AVX512)

struct Mask {
  __mmask16 bits;
};
D2_INLINE Mask operator&(Mask a, Mask b) { return {__mmask16(a.bits & b.bits)}; }
D2_INLINE Mask andnot(Mask a, Mask b) { return {__mmask16(a.bits & ~b.bits)}; }
D2_INLINE bool any(Mask a) { return a.bits != 0; }
D2_INLINE int count(Mask a) { return __builtin_popcount(a.bits); }
D2_INLINE unsigned lanes(Mask a) { return a.bits; }
D2_INLINE Mask operator>(Floats a, Floats b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ)}; }
D2_INLINE Mask operator>=(Floats a, Floats b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ)}; }
D2_INLINE Mask operator<(Floats a, Floats b) { return b > a; }
D2_INLINE Mask operator<=(Floats a, Floats b) { return b >= a; }
D2_INLINE Floats select(Mask m, Floats yes, Floats no) { return _mm512_mask_mov_ps(no.v, m.bits, yes.v); }
D2_INLINE Floats where(Mask m, Floats yes) { return _mm512_maskz_mov_ps(m.bits, yes.v); }
D2_INLINE Floats fma(Floats a, Floats b, Floats c) { return _mm512_fmadd_ps(a.v, b.v, c.v); }
D2_INLINE Floats fnma(Floats a, Floats b, Floats c) { return _mm512_fnmadd_ps(a.v, b.v, c.v); }
D2_INLINE Floats min(Floats a, Floats b) { return _mm512_min_ps(a.v, b.v); }
D2_INLINE Floats max(Floats a, Floats b) { return _mm512_max_ps(a.v, b.v); }
D2_INLINE Floats sqrt(Floats a) { return _mm512_sqrt_ps(a.v); }
D2_INLINE Floats abs(Floats a) { return _mm512_abs_ps(a.v); }
D2_INLINE Floats negative(Floats a) { return _mm512_or_ps(a.v, _mm512_set1_ps(-0.f)); }  // -|a|
D2_INLINE Floats floor(Floats a) { return _mm512_roundscale_ps(a.v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC); }
D2_INLINE Floats add_to_exponent(Floats a, Floats low_bits) {
  const __m512i exponent = _mm512_slli_epi32(_mm512_castps_si512(low_bits.v), 23);
  return _mm512_castsi512_ps(_mm512_add_epi32(_mm512_castps_si512(a.v), exponent));
}
D2_INLINE Floats reciprocal(Floats a) {
  const Floats estimate = _mm512_rcp14_ps(a.v);
  return estimate * fnma(a, estimate, Floats(2.f));
}
D2_INLINE Floats reciprocal_root(Floats a) {
  const Floats estimate = _mm512_rsqrt14_ps(a.v);
  return estimate * fnma(Floats(0.5f) * a * estimate, estimate, Floats(1.5f));
}
D2_INLINE float sum(Floats a) { return _mm512_reduce_add_ps(a.v); }
D2_INLINE float largest(Floats a) { return _mm512_reduce_max_ps(a.v); }

#elif defined(D2_AVX2)

struct Mask {
  __m256 v;
};
D2_INLINE Mask operator&(Mask a, Mask b) { return {_mm256_and_ps(a.v, b.v)}; }
D2_INLINE Mask andnot(Mask a, Mask b) { return {_mm256_andnot_ps(b.v, a.v)}; }
D2_INLINE unsigned lanes(Mask a) { return unsigned(_mm256_movemask_ps(a.v)); }
D2_INLINE bool any(Mask a) { return lanes(a) != 0; }
D2_INLINE int count(Mask a) { return __builtin_popcount(lanes(a)); }
D2_INLINE Mask operator>(Floats a, Floats b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GT_OQ)}; }
D2_INLINE Mask operator>=(Floats a, Floats b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GE_OQ)}; }
D2_INLINE Mask operator<(Floats a, Floats b) { return b > a; }
D2_INLINE Mask operator<=(Floats a, Floats b) { return b >= a; }
D2_INLINE Floats select(Mask m, Floats yes, Floats no) {
  return _mm256_or_ps(_mm256_and_ps(m.v, yes.v), _mm256_andnot_ps(m.v, no.v));
}
D2_INLINE Floats where(Mask m, Floats yes) { return _mm256_and_ps(m.v, yes.v); }
D2_INLINE Floats fma(Floats a, Floats b, Floats c) { return _mm256_fmadd_ps(a.v, b.v, c.v); }
D2_INLINE Floats fnma(Floats a, Floats b, Floats c) { return _mm256_fnmadd_ps(a.v, b.v, c.v); }
D2_INLINE Floats min(Floats a, Floats b) { return _mm256_min_ps(a.v, b.v); }
D2_INLINE Floats max(Floats a, Floats b) { return _mm256_max_ps(a.v, b.v); }
D2_INLINE Floats sqrt(Floats a) { return _mm256_sqrt_ps(a.v); }
D2_INLINE Floats abs(Floats a) { return _mm256_andnot_ps(_mm256_set1_ps(-0.f), a.v); }
D2_INLINE Floats negative(Floats a) { return _mm256_or_ps(a.v, _mm256_set1_ps(-0.f)); }
D2_INLINE Floats floor(Floats a) { return _mm256_floor_ps(a.v); }
D2_INLINE Floats reciprocal(Floats a) {
  const Floats estimate = _mm256_rcp_ps(a.v);
  return estimate * fnma(a, estimate, Floats(2.f));
}
D2_INLINE Floats reciprocal_root(Floats a) {
  const Floats estimate = _mm256_rsqrt_ps(a.v);
  return estimate * fnma(Floats(0.5f) * a * estimate, estimate, Floats(1.5f));
}
D2_INLINE Floats add_to_exponent(Floats a, Floats low_bits) {
  const __m256i exponent = _mm256_slli_epi32(_mm256_castps_si256(low_bits.v), 23);
  return _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(a.v), exponent));
}
D2_INLINE float sum(Floats a) {
  __m128 s = _mm_add_ps(_mm256_castps256_ps128(a.v), _mm256_extractf128_ps(a.v, 1));
  s = _mm_add_ps(s, _mm_movehl_ps(s, s));
  return _mm_cvtss_f32(_mm_add_ss(s, _mm_movehdup_ps(s)));
}
D2_INLINE float largest(Floats a) {
  __m128 s = _mm_max_ps(_mm256_castps256_ps128(a.v), _mm256_extractf128_ps(a.v, 1));
  s = _mm_max_ps(s, _mm_movehl_ps(s, s));
  return _mm_cvtss_f32(_mm_max_ss(s, _mm_movehdup_ps(s)));
}

#else

struct Mask {
  Integers v;
};
D2_INLINE Mask operator&(Mask a, Mask b) { return {a.v & b.v}; }
D2_INLINE Mask andnot(Mask a, Mask b) { return {a.v & ~b.v}; }
D2_INLINE unsigned lanes(Mask a) { return (a.v[0] & 1) | (a.v[1] & 2) | (a.v[2] & 4) | (a.v[3] & 8); }
D2_INLINE bool any(Mask a) { return (a.v[0] | a.v[1] | a.v[2] | a.v[3]) != 0; }
D2_INLINE int count(Mask a) { return -(a.v[0] + a.v[1] + a.v[2] + a.v[3]); }
D2_INLINE Mask operator>(Floats a, Floats b) { return {a.v > b.v}; }
D2_INLINE Mask operator>=(Floats a, Floats b) { return {a.v >= b.v}; }
D2_INLINE Mask operator<(Floats a, Floats b) { return {a.v < b.v}; }
D2_INLINE Mask operator<=(Floats a, Floats b) { return {a.v <= b.v}; }
D2_INLINE Floats select(Mask m, Floats yes, Floats no) {
  return Native((Integers(yes.v) & m.v) | (Integers(no.v) & ~m.v));
}
D2_INLINE Floats where(Mask m, Floats yes) { return Native(Integers(yes.v) & m.v); }
D2_INLINE Floats fma(Floats a, Floats b, Floats c) { return a * b + c; }
D2_INLINE Floats fnma(Floats a, Floats b, Floats c) { return c - a * b; }
D2_INLINE Floats min(Floats a, Floats b) { return select(a < b, a, b); }
D2_INLINE Floats max(Floats a, Floats b) { return select(a > b, a, b); }
D2_INLINE Floats sqrt(Floats a) {
  return Native{__builtin_sqrtf(a.v[0]), __builtin_sqrtf(a.v[1]), __builtin_sqrtf(a.v[2]), __builtin_sqrtf(a.v[3])};
}
D2_INLINE Floats abs(Floats a) { return Native(Integers(a.v) & 0x7fffffff); }
D2_INLINE Floats negative(Floats a) { return Native(Integers(a.v) | int32_t(0x80000000)); }
// Beyond 2^22 a float is an integer as far as any pixel is concerned; converting more than 2^31 would be undefined.
D2_INLINE Floats round(Floats a) {
  const Floats bounded = max(min(a, Floats(4194304.f)), Floats(-4194304.f));
  const Floats magic = 12582912.f;  // 1.5 * 2^23: adding it leaves no bits for a fraction
  return select(abs(a) < Floats(4194304.f), (bounded + magic) - magic, a);
}
D2_INLINE Floats floor(Floats a) {
  const Floats near = round(a);
  return near - where(near > a, Floats(1.f));
}
D2_INLINE Floats reciprocal(Floats a) { return Floats(1.f) / a; }
D2_INLINE Floats reciprocal_root(Floats a) { return Floats(1.f) / sqrt(a); }
D2_INLINE Floats add_to_exponent(Floats a, Floats low_bits) {
  return Native(Integers(a.v) + (Integers(low_bits.v) << 23));
}
D2_INLINE float sum(Floats a) { return (a.v[0] + a.v[2]) + (a.v[1] + a.v[3]); }
D2_INLINE float larger(float a, float b) { return a > b ? a : b; }
D2_INLINE float largest(Floats a) { return larger(larger(a.v[0], a.v[2]), larger(a.v[1], a.v[3])); }

#endif

// LANES bytes as numbers.
D2_INLINE Floats load_bytes(const uint8_t* from) {
#if defined(D2_AVX512)
  return _mm512_cvtepi32_ps(_mm512_cvtepu8_epi32(_mm_loadu_si128(reinterpret_cast<const __m128i*>(from))));
#elif defined(D2_AVX2)
  return _mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(from))));
#else
  return Native{float(from[0]), float(from[1]), float(from[2]), float(from[3])};
#endif
}

// 2^x for x in -126..127 by a minimax polynomial on [-1/2, 1/2], relative error 7.5e-8 before rounding; beyond, the
// result means nothing. Adding 1.5 * 2^23 rounds to an integer and leaves it in the low bits, to be shifted into the
// exponent.
D2_INLINE Floats exp2(Floats x) {
  const Floats magic = 12582912.f, shifted = x + magic, part = x - (shifted - magic);
  Floats p = fma(part, Floats(1.327647152e-3f), Floats(9.675541331e-3f));
  p = fma(p, part, Floats(5.550713275e-2f));
  p = fma(p, part, Floats(2.402211972e-1f));
  p = fma(p, part, Floats(6.931469671e-1f));
  p = fma(p, part, Floats(1.000000072f));
  return add_to_exponent(p, shifted);
}

// log2 of positive normal x: exponent plus the series of 2 atanh((m - 1) / (m + 1)) / ln 2 for m in sqrt(1/2)..sqrt(2).
D2_INLINE Floats log2(Floats x) {
  Integers bits;
  std::memcpy(&bits, &x.v, sizeof bits);
  const Integers exponent = (bits - 0x3f3504f3) >> 23;
  const Integers mantissa = bits - (exponent << 23);
  Floats m;
  std::memcpy(&m.v, &mantissa, sizeof mantissa);
  const Floats e = __builtin_convertvector(exponent, Native);
  const Floats s = (m - Floats(1.f)) / (m + Floats(1.f)), s2 = s * s;
  Floats p = fma(s2, Floats(0.3205989f), Floats(0.41219858f));
  p = fma(p, s2, Floats(0.57707802f));
  p = fma(p, s2, Floats(0.96179669f));
  p = fma(p, s2, Floats(2.8853900f));
  return fma(p, s, e);
}

// Sums of several vectors at once, by transposing instead of folding each: store_sums puts the sum of parts[i] in out[i]
// (and writes whole vectors, hence up to LANES - 1 floats too many), store_quad does four of them.
#if defined(D2_AVX512)
D2_INLINE __m512 pair_sums(__m512 a, __m512 b) { return _mm512_unpacklo_ps(a, b) + _mm512_unpackhi_ps(a, b); }
D2_INLINE __m512 quad_sums(__m512 a, __m512 b) {
  const __m512d x = _mm512_castps_pd(a), y = _mm512_castps_pd(b);
  return _mm512_castpd_ps(_mm512_unpacklo_pd(x, y)) + _mm512_castpd_ps(_mm512_unpackhi_pd(x, y));
}
D2_INLINE __m512 lane_sums(__m512 a, __m512 b) {
  return _mm512_shuffle_f32x4(a, b, 0x88) + _mm512_shuffle_f32x4(a, b, 0xdd);
}
D2_INLINE void store_quad(const Floats* parts, float* out) {
  const __m512 quad = quad_sums(pair_sums(parts[0].v, parts[1].v), pair_sums(parts[2].v, parts[3].v));
  const __m256 half = _mm512_castps512_ps256(quad) + _mm512_extractf32x8_ps(quad, 1);
  _mm_storeu_ps(out, _mm256_castps256_ps128(half) + _mm256_extractf128_ps(half, 1));
}
template <int N>
D2_INLINE void store_sums(const Floats* parts, float* out) {
  for (int first = 0; first < N; first += 16) {
    __m512 quads[4];
    for (int q = 0; q < 4; q++) {
      const auto part = [&](int i) { return first + 4 * q + i < N ? parts[first + 4 * q + i].v : _mm512_setzero_ps(); };
      quads[q] = quad_sums(pair_sums(part(0), part(1)), pair_sums(part(2), part(3)));
    }
    Floats(lane_sums(lane_sums(quads[0], quads[1]), lane_sums(quads[2], quads[3]))).store(out + first);
  }
}
#elif defined(D2_AVX2)
D2_INLINE __m256 pair_sums(__m256 a, __m256 b) { return _mm256_unpacklo_ps(a, b) + _mm256_unpackhi_ps(a, b); }
D2_INLINE __m256 quad_sums(__m256 a, __m256 b) {
  const __m256d x = _mm256_castps_pd(a), y = _mm256_castps_pd(b);
  return _mm256_castpd_ps(_mm256_unpacklo_pd(x, y)) + _mm256_castpd_ps(_mm256_unpackhi_pd(x, y));
}
D2_INLINE void store_quad(const Floats* parts, float* out) {
  const __m256 quad = quad_sums(pair_sums(parts[0].v, parts[1].v), pair_sums(parts[2].v, parts[3].v));
  _mm_storeu_ps(out, _mm256_castps256_ps128(quad) + _mm256_extractf128_ps(quad, 1));
}
template <int N>
D2_INLINE void store_sums(const Floats* parts, float* out) {
  for (int first = 0; first < N; first += 8) {
    __m256 quads[2];
    for (int q = 0; q < 2; q++) {
      const auto part = [&](int i) { return first + 4 * q + i < N ? parts[first + 4 * q + i].v : _mm256_setzero_ps(); };
      quads[q] = quad_sums(pair_sums(part(0), part(1)), pair_sums(part(2), part(3)));
    }
    const __m256 low = _mm256_permute2f128_ps(quads[0], quads[1], 0x20);
    Floats(low + _mm256_permute2f128_ps(quads[0], quads[1], 0x31)).store(out + first);
  }
}
#else
template <int N>
D2_INLINE void store_sums(const Floats* parts, float* out) {
  for (int i = 0; i < N; i++) out[i] = sum(parts[i]);
}
D2_INLINE void store_quad(const Floats* parts, float* out) { store_sums<4>(parts, out); }
#endif

// Lane i of a vector that is put together from others: lane from[i] % LANES of the vector from[i] / LANES.
struct Choice {
  alignas(64) int32_t from[LANES];
};

#if defined(D2_AVX512)
D2_INLINE Floats pick(const Floats (&v)[2], const Choice& choice) {
  return _mm512_permutex2var_ps(v[0].v, _mm512_load_si512(choice.from), v[1].v);
}
D2_INLINE Floats pick(const Floats (&v)[3], const Choice& choice) {
  const __m512i from = _mm512_load_si512(choice.from);
  const __mmask16 third = _mm512_test_epi32_mask(from, _mm512_set1_epi32(2 * LANES));
  return _mm512_mask_permutexvar_ps(_mm512_permutex2var_ps(v[0].v, from, v[1].v), third, from, v[2].v);
}
#elif defined(D2_AVX2)
D2_INLINE Floats pick(const Floats (&v)[2], const Choice& choice) {
  const __m256i from = _mm256_load_si256(reinterpret_cast<const __m256i*>(choice.from));
  const __m256 first = _mm256_permutevar8x32_ps(v[0].v, from), second = _mm256_permutevar8x32_ps(v[1].v, from);
  return _mm256_blendv_ps(first, second, _mm256_castsi256_ps(_mm256_slli_epi32(from, 28)));  // by the bit of LANES
}
D2_INLINE Floats pick(const Floats (&v)[3], const Choice& choice) {
  const __m256i from = _mm256_load_si256(reinterpret_cast<const __m256i*>(choice.from));
  const Floats two = pick({v[0], v[1]}, choice), third = _mm256_permutevar8x32_ps(v[2].v, from);
  return _mm256_blendv_ps(two.v, third.v, _mm256_castsi256_ps(_mm256_slli_epi32(from, 27)));
}
#else
template <int N>
D2_INLINE Floats pick(const Floats (&v)[N], const Choice& choice) {
  Native out;
  for (int i = 0; i < LANES; i++) out[i] = v[choice.from[i] / LANES].v[choice.from[i] % LANES];
  return out;
}
#endif

// N vectors of one quantity each to and from vectors as memory holds them, in which the N quantities of a pixel or of a
// row follow each other: GROUP of them in one piece of memory, LANES / GROUP such pieces in one vector.
template <int N, int GROUP>
struct Woven {
  Choice apart[N], together[N];
  static constexpr int lane(int piece, int place) { return place / GROUP * LANES + piece * GROUP + place % GROUP; }
  constexpr Woven() : apart(), together() {
    for (int piece = 0; piece < LANES / GROUP; piece++)
      for (int item = 0; item < GROUP; item++)
        for (int n = 0; n < N; n++) {
          const int place = item * N + n, here = lane(piece, place), there = piece * GROUP + item;
          apart[n].from[there] = here;
          together[here / LANES].from[here % LANES] = n * LANES + there;
        }
  }
};
template <int N, int GROUP>
static constexpr Woven<N, GROUP> WOVEN = Woven<N, GROUP>();
template <int GROUP, int N>
D2_INLINE void unweave(const Floats (&woven)[N], Floats (&out)[N]) {
  for (int n = 0; n < N; n++) out[n] = pick(woven, WOVEN<N, GROUP>.apart[n]);
}
template <int GROUP, int N>
D2_INLINE void weave(const Floats (&parts)[N], Floats (&woven)[N]) {
  for (int n = 0; n < N; n++) woven[n] = pick(parts, WOVEN<N, GROUP>.together[n]);
}

// LANES rows of N floats each, as N vectors: vector n holds number n of every row.
template <int N>
D2_INLINE void load_rows(const float* rows, Floats (&out)[N]) {
  Floats woven[N];
  for (int n = 0; n < N; n++) woven[n] = Floats::load(rows + n * LANES);
  if constexpr (N == 1) {
    out[0] = woven[0];
  } else if constexpr (N < 4) {
    unweave<LANES>(woven, out);
  } else {
    static_assert(N == 6, "2, 3 or twice 3 are unwoven");
    Floats even[3], odd[3], half[3];
    for (int n = 0; n < 3; n++) {
      const Floats both[2] = {woven[2 * n], woven[2 * n + 1]};
      even[n] = pick(both, WOVEN<2, LANES>.apart[0]), odd[n] = pick(both, WOVEN<2, LANES>.apart[1]);
    }
    unweave<LANES>(even, half);
    for (int n = 0; n < 3; n++) out[2 * n] = half[n];
    unweave<LANES>(odd, half);
    for (int n = 0; n < 3; n++) out[2 * n + 1] = half[n];
  }
}
template <int N>
D2_INLINE void store_rows(const Floats (&parts)[N], float* rows) {
  Floats woven[N];
  if constexpr (N == 1) {
    woven[0] = parts[0];
  } else if constexpr (N < 4) {
    weave<LANES>(parts, woven);
  } else {
    static_assert(N == 6, "2, 3 or twice 3 are woven");
    Floats even[3], odd[3];
    weave<LANES>({parts[0], parts[2], parts[4]}, even);
    weave<LANES>({parts[1], parts[3], parts[5]}, odd);
    for (int n = 0; n < 3; n++) {
      const Floats both[2] = {even[n], odd[n]};
      woven[2 * n] = pick(both, WOVEN<2, LANES>.together[0]);
      woven[2 * n + 1] = pick(both, WOVEN<2, LANES>.together[1]);
    }
  }
  for (int n = 0; n < N; n++) woven[n].store(rows + n * LANES);
}

// Rows of LANES floats, `stride` apart, to and from LANES vectors: lane i of vector n is number n of row i.
#if defined(D2_AVX512)
D2_INLINE void transpose(Floats (&m)[LANES]) {
  __m512 a[16], b[16];
  for (int i = 0; i < 16; i += 2) {
    a[i] = _mm512_unpacklo_ps(m[i].v, m[i + 1].v);
    a[i + 1] = _mm512_unpackhi_ps(m[i].v, m[i + 1].v);
  }
  for (int i = 0; i < 16; i += 4)
    for (int k = 0; k < 2; k++) {
      const __m512d x = _mm512_castps_pd(a[i + k]), y = _mm512_castps_pd(a[i + k + 2]);
      b[i + 2 * k] = _mm512_castpd_ps(_mm512_unpacklo_pd(x, y));
      b[i + 2 * k + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(x, y));
    }
  // b[4 q + k]: quarter p holds number 4 p + k of rows 4 q..4 q + 3.
  for (int k = 0; k < 4; k++) {
    const __m512 even_low = _mm512_shuffle_f32x4(b[k], b[4 + k], 0x88), odd_low = _mm512_shuffle_f32x4(b[k], b[4 + k], 0xdd);
    const __m512 even_high = _mm512_shuffle_f32x4(b[8 + k], b[12 + k], 0x88);
    const __m512 odd_high = _mm512_shuffle_f32x4(b[8 + k], b[12 + k], 0xdd);
    m[k] = _mm512_shuffle_f32x4(even_low, even_high, 0x88), m[8 + k] = _mm512_shuffle_f32x4(even_low, even_high, 0xdd);
    m[4 + k] = _mm512_shuffle_f32x4(odd_low, odd_high, 0x88), m[12 + k] = _mm512_shuffle_f32x4(odd_low, odd_high, 0xdd);
  }
}
#elif defined(D2_AVX2)
D2_INLINE void transpose(Floats (&m)[LANES]) {
  __m256 a[8], b[8];
  for (int i = 0; i < 8; i += 2) {
    a[i] = _mm256_unpacklo_ps(m[i].v, m[i + 1].v);
    a[i + 1] = _mm256_unpackhi_ps(m[i].v, m[i + 1].v);
  }
  for (int i = 0; i < 8; i += 4)
    for (int k = 0; k < 2; k++) {
      b[i + 2 * k] = _mm256_shuffle_ps(a[i + k], a[i + k + 2], 0x44);
      b[i + 2 * k + 1] = _mm256_shuffle_ps(a[i + k], a[i + k + 2], 0xee);
    }
  // b[4 q + k]: half p holds number 4 p + k of rows 4 q..4 q + 3.
  for (int k = 0; k < 4; k++) {
    m[k] = _mm256_permute2f128_ps(b[k], b[4 + k], 0x20);
    m[4 + k] = _mm256_permute2f128_ps(b[k], b[4 + k], 0x31);
  }
}
#else
D2_INLINE void transpose(Floats (&m)[LANES]) {
  for (int i = 0; i < LANES; i++)
    for (int j = i + 1; j < LANES; j++) {
      const float kept = m[i].v[j];
      m[i].v[j] = m[j].v[i], m[j].v[i] = kept;
    }
}
#endif

// A block of pixels from and to an image whose rows are `stride` floats apart.
#if defined(D2_AVX512)
D2_INLINE Floats load_block(const float* from, int64_t stride) {
  const __m256 low = _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(from)), _mm_loadu_ps(from + stride), 1);
  const float* below = from + 2 * stride;
  const __m256 high = _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(below)), _mm_loadu_ps(below + stride), 1);
  return _mm512_insertf32x8(_mm512_castps256_ps512(low), high, 1);
}
D2_INLINE void store_block(Floats block, float* to, int64_t stride) {
  _mm_storeu_ps(to, _mm512_castps512_ps128(block.v));
  _mm_storeu_ps(to + stride, _mm512_extractf32x4_ps(block.v, 1));
  _mm_storeu_ps(to + 2 * stride, _mm512_extractf32x4_ps(block.v, 2));
  _mm_storeu_ps(to + 3 * stride, _mm512_extractf32x4_ps(block.v, 3));
}
#else
D2_INLINE Floats load_block(const float* from, int64_t stride) {
  Floats out;
  for (int y = 0; y < BLOCK_HEIGHT; y++)
    std::memcpy(reinterpret_cast<char*>(&out.v) + 4 * y * BLOCK_WIDTH, from + y * stride, 4 * BLOCK_WIDTH);
  return out;
}
D2_INLINE void store_block(Floats block, float* to, int64_t stride) {
  for (int y = 0; y < BLOCK_HEIGHT; y++)
    std::memcpy(to + y * stride, reinterpret_cast<const char*>(&block.v) + 4 * y * BLOCK_WIDTH, 4 * BLOCK_WIDTH);
}
#endif

}  // namespace d2
