// One vector of floats and one of integers, for AVX-512 (16 lanes), AVX2 (8) and anything else (4), with the names that
// numbers.h has for one number. The vector extension of GCC and Clang does all but what is written out here.
#pragma once

#include <cstdint>
#include <cstring>

#include "numbers.h"

#if defined(__AVX512F__) || (defined(__AVX2__) && defined(__FMA__))
#include <immintrin.h>
#endif

namespace d2 {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX2__) && defined(__FMA__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif
typedef float Floats __attribute__((vector_size(4 * kLanes)));
typedef int32_t Integers __attribute__((vector_size(4 * kLanes)));
typedef uint32_t Unsigneds __attribute__((vector_size(4 * kLanes)));
template <>
struct Kind<Floats> {
  typedef Integers Mask;
  typedef Integers Whole;
  typedef Unsigneds Word;
};
constexpr unsigned kAllLanes = (1u << kLanes) - 1;

template <class V, class E>
D2_FN V load(const E* from) {
  V v;
  std::memcpy(&v, from, sizeof v);
  return v;
}
D2_FN void store(float* to, Floats v) { std::memcpy(to, &v, sizeof v); }

D2_FN Integers whole(Floats a) { return __builtin_convertvector(a, Integers); }
D2_FN Floats real(Integers a) { return __builtin_convertvector(a, Floats); }
D2_FN Floats bits_float(Integers a) { return (Floats)a; }
D2_FN Floats pick(Integers yes, Floats a, Floats b) { return yes ? a : b; }
D2_FN Integers pick(Integers yes, Integers a, Integers b) { return yes ? a : b; }
D2_FN Unsigneds pick(Integers yes, Unsigneds a, Unsigneds b) { return (Unsigneds)(yes ? (Integers)a : (Integers)b); }
D2_FN Integers opposite(Integers yes) { return ~yes; }
D2_FN int first_lane(Integers a) { return a[0]; }

#if defined(__AVX512F__)
D2_FN Floats mad(Floats a, Floats b, Floats c) { return (Floats)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c); }
D2_FN Floats smaller(Floats a, Floats b) { return (Floats)_mm512_min_ps((__m512)a, (__m512)b); }
D2_FN Floats larger(Floats a, Floats b) { return (Floats)_mm512_max_ps((__m512)a, (__m512)b); }
D2_FN Floats root(Floats a) { return (Floats)_mm512_sqrt_ps((__m512)a); }
D2_FN Integers look_up(const unsigned* from, Integers place) {
  return (Integers)_mm512_i32gather_epi32((__m512i)place, from, 4);
}
D2_FN Floats look_up(const float* from, Integers place) { return (Floats)_mm512_i32gather_ps((__m512i)place, from, 4); }
D2_FN Floats reordered(Floats a, Integers lane) { return (Floats)_mm512_permutexvar_ps((__m512i)lane, (__m512)a); }
D2_FN unsigned bits(Integers yes) { return _mm512_cmplt_epi32_mask((__m512i)yes, _mm512_setzero_si512()); }
D2_FN void pack(float* to, unsigned lanes, Floats a) {
  _mm512_storeu_ps(to, _mm512_maskz_compress_ps(__mmask16(lanes), (__m512)a));
}
#elif defined(__AVX2__) && defined(__FMA__)
D2_FN Floats mad(Floats a, Floats b, Floats c) { return (Floats)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c); }
D2_FN Floats smaller(Floats a, Floats b) { return (Floats)_mm256_min_ps((__m256)a, (__m256)b); }
D2_FN Floats larger(Floats a, Floats b) { return (Floats)_mm256_max_ps((__m256)a, (__m256)b); }
D2_FN Floats root(Floats a) { return (Floats)_mm256_sqrt_ps((__m256)a); }
D2_FN Integers look_up(const unsigned* from, Integers place) {
  return (Integers)_mm256_i32gather_epi32(reinterpret_cast<const int*>(from), (__m256i)place, 4);
}
D2_FN Floats look_up(const float* from, Integers place) { return (Floats)_mm256_i32gather_ps(from, (__m256i)place, 4); }
D2_FN Floats reordered(Floats a, Integers lane) { return (Floats)_mm256_permutevar8x32_ps((__m256)a, (__m256i)lane); }
D2_FN unsigned bits(Integers yes) { return unsigned(_mm256_movemask_ps((__m256)yes)); }
#else
// Lane l is lane(l).
template <class V, class Lane>
D2_FN V by_lanes(const Lane& lane) {
  V v;
  for (int l = 0; l < kLanes; l++) v[l] = lane(l);
  return v;
}
D2_FN Floats mad(Floats a, Floats b, Floats c) {
  return by_lanes<Floats>([&](int l) { return mad(a[l], b[l], c[l]); });
}
D2_FN Floats smaller(Floats a, Floats b) { return a < b ? a : b; }
D2_FN Floats larger(Floats a, Floats b) { return a > b ? a : b; }
D2_FN Floats root(Floats a) { return by_lanes<Floats>([&](int l) { return root(a[l]); }); }
D2_FN Integers look_up(const unsigned* from, Integers place) {
  return by_lanes<Integers>([&](int l) { return int(from[place[l]]); });
}
D2_FN Floats look_up(const float* from, Integers place) {
  return by_lanes<Floats>([&](int l) { return from[place[l]]; });
}
// Lane l takes what is in lane lane[l].
D2_FN Floats reordered(Floats a, Integers lane) { return by_lanes<Floats>([&](int l) { return a[lane[l]]; }); }
// Bit l says whether lane l of a comparison is true.
D2_FN unsigned bits(Integers yes) {
  unsigned found = 0;
  for (int l = 0; l < kLanes; l++) found |= (yes[l] < 0 ? 1u : 0u) << l;
  return found;
}
#endif
D2_FN bool none(Integers yes) { return bits(yes) == 0; }

#if defined(__AVX512BW__)
// A byte k in the lowest bits of 2^23 is 2^23 + k, and differences of such numbers are exact.
D2_FN Corners<Floats> corners_of(Integers quad) {
  const __m512i large = _mm512_set1_epi32(0x4b000000);
  const auto byte = [&](int k) {
    const __m512i from = _mm512_add_epi32(_mm512_set4_epi32(12, 8, 4, 0), _mm512_set1_epi32(k));
    return (Floats)_mm512_mask_shuffle_epi8(large, 0x1111111111111111, (__m512i)quad, from);
  };
  const Floats g00 = byte(0), g10 = byte(2), zero = (Floats)large;
  return {g00 - zero, byte(1) - g00, g10 - zero, byte(3) - g10};
}
#else
D2_FN Corners<Floats> corners_of(Integers quad) {
  const Floats g00 = real(quad & 255), g01 = real(quad >> 8 & 255), g10 = real(quad >> 16 & 255);
  return {g00, g01 - g00, g10, real(quad >> 24 & 255) - g10};
}
#endif
#if !defined(__AVX512F__)
// The lanes whose bit is 1, one after the other; writes kLanes numbers, of which the rest mean nothing.
D2_FN void pack(float* to, unsigned lanes, Floats a) {
  for (; lanes; lanes &= lanes - 1) *to++ = a[__builtin_ctz(lanes)];
}
#endif

}  // namespace d2
