// One vector of floats and its comparison mask, for AVX-512 (16 lanes), AVX2 (8) and anything else (4, through the
// vector extension of GCC and Clang). Loops over pixels and Gaussians are written once on top of it.
//
// Fused multiply-adds are written out and the build forbids the compiler to contract others, so that the same formula
// gives the same bits wherever it is inlined: the backward pass replays the decisions of the forward pass.
#pragma once

#include <cstdint>
#include <cstring>
#include <utility>

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
  D2_INLINE Floats(float value) : v(value - Native{}) {}
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
D2_INLINE unsigned lanes(Mask a) { return a.bits; }
D2_INLINE Mask operator>(Floats a, Floats b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ)}; }
D2_INLINE Mask operator>=(Floats a, Floats b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ)}; }
D2_INLINE Floats select(Mask m, Floats yes, Floats no) { return _mm512_mask_mov_ps(no.v, m.bits, yes.v); }
D2_INLINE Floats where(Mask m, Floats yes) { return _mm512_maskz_mov_ps(m.bits, yes.v); }
D2_INLINE Floats fma(Floats a, Floats b, Floats c) { return _mm512_fmadd_ps(a.v, b.v, c.v); }
D2_INLINE Floats fnma(Floats a, Floats b, Floats c) { return _mm512_fnmadd_ps(a.v, b.v, c.v); }
D2_INLINE Floats min(Floats a, Floats b) { return _mm512_min_ps(a.v, b.v); }
D2_INLINE Floats max(Floats a, Floats b) { return _mm512_max_ps(a.v, b.v); }
D2_INLINE Floats sqrt(Floats a) { return _mm512_sqrt_ps(a.v); }
D2_INLINE Floats floor(Floats a) { return _mm512_roundscale_ps(a.v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC); }
D2_INLINE Floats near_reciprocal(Floats a) { return _mm512_rcp14_ps(a.v); }
D2_INLINE Floats near_reciprocal_root(Floats a) { return _mm512_rsqrt14_ps(a.v); }
D2_INLINE float sum(Floats a) { return _mm512_reduce_add_ps(a.v); }
D2_INLINE float largest(Floats a) { return _mm512_reduce_max_ps(a.v); }
#else
struct Mask {
  Integers v;
};
D2_INLINE Mask operator&(Mask a, Mask b) { return {a.v & b.v}; }
D2_INLINE Mask andnot(Mask a, Mask b) { return {a.v & ~b.v}; }
D2_INLINE Mask operator>(Floats a, Floats b) { return {a.v > b.v}; }
D2_INLINE Mask operator>=(Floats a, Floats b) { return {a.v >= b.v}; }
D2_INLINE Floats select(Mask m, Floats yes, Floats no) {
  return Native((Integers(yes.v) & m.v) | (Integers(no.v) & ~m.v));
}
D2_INLINE Floats where(Mask m, Floats yes) { return Native(Integers(yes.v) & m.v); }
#if defined(D2_AVX2)
D2_INLINE unsigned lanes(Mask a) { return unsigned(_mm256_movemask_ps(__m256(a.v))); }
D2_INLINE Floats fma(Floats a, Floats b, Floats c) { return _mm256_fmadd_ps(a.v, b.v, c.v); }
D2_INLINE Floats fnma(Floats a, Floats b, Floats c) { return _mm256_fnmadd_ps(a.v, b.v, c.v); }
D2_INLINE Floats min(Floats a, Floats b) { return _mm256_min_ps(a.v, b.v); }
D2_INLINE Floats max(Floats a, Floats b) { return _mm256_max_ps(a.v, b.v); }
D2_INLINE Floats sqrt(Floats a) { return _mm256_sqrt_ps(a.v); }
D2_INLINE Floats floor(Floats a) { return _mm256_floor_ps(a.v); }
D2_INLINE Floats near_reciprocal(Floats a) { return _mm256_rcp_ps(a.v); }
D2_INLINE Floats near_reciprocal_root(Floats a) { return _mm256_rsqrt_ps(a.v); }
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
D2_INLINE unsigned lanes(Mask a) { return (a.v[0] & 1) | (a.v[1] & 2) | (a.v[2] & 4) | (a.v[3] & 8); }
D2_INLINE Floats fma(Floats a, Floats b, Floats c) { return a * b + c; }
D2_INLINE Floats fnma(Floats a, Floats b, Floats c) { return c - a * b; }
D2_INLINE Floats min(Floats a, Floats b) { return select(b > a, a, b); }
D2_INLINE Floats max(Floats a, Floats b) { return select(a > b, a, b); }
D2_INLINE Floats sqrt(Floats a) {
  return Native{__builtin_sqrtf(a.v[0]), __builtin_sqrtf(a.v[1]), __builtin_sqrtf(a.v[2]), __builtin_sqrtf(a.v[3])};
}
// Beyond 2^22 a float is an integer as far as any pixel is concerned; converting more than 2^31 would be undefined.
D2_INLINE Floats floor(Floats a) {
  const Floats bounded = max(min(a, Floats(4194304.f)), Floats(-4194304.f));
  const Floats magic = 12582912.f;  // 1.5 * 2^23: adding it leaves no bits for a fraction
  const Floats magnitude = Native(Integers(a.v) & 0x7fffffff);
  const Floats near = select(Floats(4194304.f) > magnitude, (bounded + magic) - magic, a);
  return near - where(near > a, Floats(1.f));
}
D2_INLINE float sum(Floats a) { return (a.v[0] + a.v[2]) + (a.v[1] + a.v[3]); }
D2_INLINE float larger(float a, float b) { return a > b ? a : b; }
D2_INLINE float largest(Floats a) { return larger(larger(a.v[0], a.v[2]), larger(a.v[1], a.v[3])); }
#endif
#endif

D2_INLINE bool any(Mask a) { return lanes(a) != 0; }
D2_INLINE int count(Mask a) { return __builtin_popcount(lanes(a)); }
D2_INLINE Mask operator<(Floats a, Floats b) { return b > a; }
D2_INLINE Mask operator<=(Floats a, Floats b) { return b >= a; }
D2_INLINE Floats abs(Floats a) { return Native(Integers(a.v) & 0x7fffffff); }
D2_INLINE Floats negative(Floats a) { return Native(Integers(a.v) | int32_t(0x80000000)); }  // -|a|
D2_INLINE Floats add_to_exponent(Floats a, Floats low_bits) {
  return Native(Integers(a.v) + (Integers(low_bits.v) << 23));
}
D2_INLINE Floats reciprocal(Floats a) {
#if defined(D2_AVX512) || defined(D2_AVX2)
  const Floats estimate = near_reciprocal(a);
  return estimate * fnma(a, estimate, Floats(2.f));
#else
  return Floats(1.f) / a;
#endif
}
D2_INLINE Floats reciprocal_root(Floats a) {
#if defined(D2_AVX512) || defined(D2_AVX2)
  const Floats estimate = near_reciprocal_root(a);
  return estimate * fnma(Floats(0.5f) * a * estimate, estimate, Floats(1.5f));
#else
  return Floats(1.f) / sqrt(a);
#endif
}

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

// A vector put together from v: its lane i is lane Places::at(i) % LANES of vector Places::at(i) / LANES. One shuffle for
// each vector after the first; what other shuffles put in place stays.
template <class Places, int next>
constexpr int lane_of_two(int lane) {
  const int from = Places::at(lane);
  return from / LANES == next ? LANES + from % LANES : next > 1 ? lane : from % LANES;
}
template <class Places, int next, int... lane>
D2_INLINE Native shuffle(Native a, Native b, std::integer_sequence<int, lane...>) {
#if defined(__clang__)
  return __builtin_shufflevector(a, b, lane_of_two<Places, next>(lane)...);
#else
  return __builtin_shuffle(a, b, Integers{lane_of_two<Places, next>(lane)...});
#endif
}
template <class Places, int N, int next = 1>
D2_INLINE Native pick(const Floats* v, Native joined) {
  if constexpr (next < N) {
    const auto all = std::make_integer_sequence<int, LANES>();
    return pick<Places, N, next + 1>(v, shuffle<Places, next>(joined, v[next].v, all));
  } else {
    return joined;
  }
}

// N vectors of one quantity each to and from vectors as memory holds them, in which the N quantities of a pixel or of a
// row follow each other: GROUP of them in one piece of memory, LANES / GROUP such pieces in one vector. With LANES as
// GROUP, vector n holds number n of LANES rows of N.
template <int GROUP, int N, int n>
struct Apart {
  static constexpr int at(int lane) {
    const int place = lane % GROUP * N + n;
    return place / GROUP * LANES + lane / GROUP * GROUP + place % GROUP;
  }
};
template <int GROUP, int N, int n>
struct Together {
  static constexpr int at(int lane) {
    const int place = n * GROUP + lane % GROUP;
    return place % N * LANES + lane / GROUP * GROUP + place / N;
  }
};
template <int GROUP, int N, int n = 0>
D2_INLINE void unweave(const Floats* woven, Floats* out) {
  out[n] = pick<Apart<GROUP, N, n>, N>(woven, woven[0].v);
  if constexpr (n + 1 < N) unweave<GROUP, N, n + 1>(woven, out);
}
template <int GROUP, int N, int n = 0>
D2_INLINE void weave(const Floats* parts, Floats* woven) {
  woven[n] = pick<Together<GROUP, N, n>, N>(parts, parts[0].v);
  if constexpr (n + 1 < N) weave<GROUP, N, n + 1>(parts, woven);
}

// LANES rows of N floats each, as N vectors: vector n holds number n of every row.
template <int N>
D2_INLINE void load_rows(const float* rows, Floats* out) {
  Floats woven[N];
  for (int n = 0; n < N; n++) woven[n] = Floats::load(rows + n * LANES);
  unweave<LANES, N>(woven, out);
}
template <int N>
D2_INLINE void store_rows(const Floats* parts, float* rows) {
  Floats woven[N];
  weave<LANES, N>(parts, woven);
  for (int n = 0; n < N; n++) woven[n].store(rows + n * LANES);
}

// Lane i of vector n becomes lane n of vector i: blocks of `apart` lanes and vectors change places, smallest first.
template <int apart, bool upper>
struct Exchanged {
  static constexpr int at(int lane) { return (lane & apart ? LANES : 0) + (lane & ~apart) + upper * apart; }
};
template <int apart = 1>
D2_INLINE void transpose(Floats (&m)[LANES]) {
  for (int i = 0; i < LANES; i++) {
    if (i & apart) continue;
    const Floats both[2] = {m[i], m[i + apart]};
    m[i] = pick<Exchanged<apart, false>, 2>(both, both[0].v);
    m[i + apart] = pick<Exchanged<apart, true>, 2>(both, both[0].v);
  }
  if constexpr (2 * apart < LANES) transpose<2 * apart>(m);
}

// A block of pixels from and to an image whose rows are `stride` floats apart.
D2_INLINE Floats load_block(const float* from, int64_t stride) {
#if defined(D2_AVX512)  // put together in memory, a vector waits for its parts to be written
  const __m256 low = _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(from)), _mm_loadu_ps(from + stride), 1);
  const float* below = from + 2 * stride;
  const __m256 high = _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(below)), _mm_loadu_ps(below + stride), 1);
  return _mm512_insertf32x8(_mm512_castps256_ps512(low), high, 1);
#else
  Floats out;
  for (int y = 0; y < BLOCK_HEIGHT; y++)
    std::memcpy(reinterpret_cast<char*>(&out.v) + 4 * y * BLOCK_WIDTH, from + y * stride, 4 * BLOCK_WIDTH);
  return out;
#endif
}
D2_INLINE void store_block(Floats block, float* to, int64_t stride) {
  for (int y = 0; y < BLOCK_HEIGHT; y++)
    std::memcpy(to + y * stride, reinterpret_cast<const char*>(&block.v) + 4 * y * BLOCK_WIDTH, 4 * BLOCK_WIDTH);
}

}  // namespace d2
