// Arithmetic of one number, with the names that lanes.h has for a vector. `mad` says where a product is not rounded and
// the build forbids the compiler to fuse others, so that every device with a fused multiply-add returns the same bits.
// No header is included, so that NVRTC compiles it without a toolkit.
#pragma once

#if defined(__CUDACC__)
#define D2_FN __host__ __device__ __forceinline__
#else
#define D2_FN inline __attribute__((always_inline))
#endif

namespace d2 {

#if defined(__CUDACC__)
D2_FN float mad(float a, float b, float c) { return fmaf(a, b, c); }
D2_FN float root(float a) { return sqrtf(a); }
D2_FN int float_bits(float a) { return __float_as_int(a); }
D2_FN float bits_float(int a) { return __int_as_float(a); }
#else
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
D2_FN float mad(float a, float b, float c) { return __builtin_fmaf(a, b, c); }
#else
D2_FN float mad(float a, float b, float c) { return a * b + c; }  // a call into a library otherwise
#endif
D2_FN float root(float a) { return __builtin_sqrtf(a); }
D2_FN int float_bits(float a) { int b; __builtin_memcpy(&b, &a, sizeof b); return b; }
D2_FN float bits_float(int a) { float b; __builtin_memcpy(&b, &a, sizeof b); return b; }
#endif
D2_FN int whole(float a) { return int(a); }  // towards zero
D2_FN float real(int a) { return float(a); }
D2_FN float pick(bool yes, float a, float b) { return yes ? a : b; }
D2_FN int pick(bool yes, int a, int b) { return yes ? a : b; }
D2_FN unsigned pick(bool yes, unsigned a, unsigned b) { return yes ? a : b; }
D2_FN bool none(bool yes) { return !yes; }  // whether it is true in no lane
D2_FN bool opposite(bool yes) { return !yes; }
D2_FN int first_lane(int a) { return a; }
// NaN in the first argument gives the second: what is not a number is sent to a border.
D2_FN float smaller(float a, float b) { return a < b ? a : b; }
D2_FN float larger(float a, float b) { return a > b ? a : b; }
D2_FN float magnitude(float a) { return a < 0 ? -a : a; }
D2_FN int look_up(const unsigned* from, int place) { return int(from[place]); }
D2_FN float look_up(const float* from, int place) { return from[place]; }

// What goes with a number, or with a vector of them (lanes.h): the result of a comparison, and integers.
template <class S>
struct Kind;
template <>
struct Kind<float> {
  typedef bool Mask;
  typedef int Whole;
  typedef unsigned Word;
};
template <class S>
using Mask = typename Kind<S>::Mask;
template <class S>
using Whole = typename Kind<S>::Whole;
template <class S>
using Word = typename Kind<S>::Word;

// The bytes of a quad, from the lowest on: a grey value, what its right neighbour is more, and the same a row below.
template <class S>
struct Corners {
  S upper, upper_step, lower, lower_step;
};
D2_FN Corners<float> corners_of(int quad) {
  const float g00 = real(quad & 255), g01 = real(quad >> 8 & 255), g10 = real(quad >> 16 & 255);
  return {g00, g01 - g00, g10, real(quad >> 24 & 255) - g10};
}

}  // namespace d2
