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

#if defined(__AVX512F__)
D2_FN Floats mad(Floats a, Floats b, Floats c) { return (Floats)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c); }
D2_FN Floats smaller(Floats a, Floats b) { return (Floats)_mm512_min_ps((__m512)a, (__m512)b); }
D2_FN Floats larger(Floats a, Floats b) { return (Floats)_mm512_max_ps((__m512)a, (__m512)b); }
D2_FN Floats root(Floats a) { return (Floats)_mm512_sqrt_ps((__m512)a); }
D2_FN Integers look_up(const unsigned* from, Integers place) {
  return (Integers)_mm512_i32gather_epi32((__m512i)place, from, 4);
}
#elif defined(__AVX2__) && defined(__FMA__)
D2_FN Floats mad(Floats a, Floats b, Floats c) { return (Floats)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c); }
D2_FN Floats smaller(Floats a, Floats b) { return (Floats)_mm256_min_ps((__m256)a, (__m256)b); }
D2_FN Floats larger(Floats a, Floats b) { return (Floats)_mm256_max_ps((__m256)a, (__m256)b); }
D2_FN Floats root(Floats a) { return (Floats)_mm256_sqrt_ps((__m256)a); }
D2_FN Integers look_up(const unsigned* from, Integers place) {
  return (Integers)_mm256_i32gather_epi32(reinterpret_cast<const int*>(from), (__m256i)place, 4);
}
#else
D2_FN Floats mad(Floats a, Floats b, Floats c) {
  Floats v;
  for (int l = 0; l < kLanes; l++) v[l] = mad(a[l], b[l], c[l]);
  return v;
}
D2_FN Floats smaller(Floats a, Floats b) { return a < b ? a : b; }
D2_FN Floats larger(Floats a, Floats b) { return a > b ? a : b; }
D2_FN Floats root(Floats a) {
  Floats v;
  for (int l = 0; l < kLanes; l++) v[l] = root(a[l]);
  return v;
}
D2_FN Integers look_up(const unsigned* from, Integers place) {
  Integers v;
  for (int l = 0; l < kLanes; l++) v[l] = int(from[place[l]]);
  return v;
}
#endif

}  // namespace d2
