// One vector register of doubles: lane l is track l of a block. Compiled once per instruction set.
//
// Neither the standard library nor the binding is included here: an inline function of theirs, compiled for a wide
// instruction set, could be the copy the linker keeps for everybody.
#pragma once

#include <cstddef>
#include <cstdint>

#define SALTUS_INLINE __attribute__((always_inline)) inline
#define SALTUS_LAMBDA __attribute__((always_inline))

namespace saltus::SALTUS_NS {

#if defined(__AVX512F__)
inline constexpr int W = 8;
#elif defined(__AVX__)
inline constexpr int W = 4;
#else
inline constexpr int W = 2;  // SSE2, NEON
#endif

typedef double V __attribute__((vector_size(8 * W)));
typedef long long I __attribute__((vector_size(8 * W)));
typedef double Unaligned __attribute__((vector_size(8 * W), aligned(8), may_alias));

SALTUS_INLINE V splat(double a) { return a - V{}; }
SALTUS_INLINE V splat(V a) { return a; }
SALTUS_INLINE V load(const double* p) { return *reinterpret_cast<const Unaligned*>(p); }
SALTUS_INLINE void store(double* p, V a) { *reinterpret_cast<Unaligned*>(p) = a; }
SALTUS_INLINE V select(I mask, V yes, V no) { return mask ? yes : no; }
SALTUS_INLINE V minimum(V a, V b) { return a < b ? a : b; }
SALTUS_INLINE V maximum(V a, V b) { return a > b ? a : b; }

SALTUS_INLINE V magnitude(V a) { return reinterpret_cast<V>(reinterpret_cast<I>(a) & 0x7fffffffffffffffLL); }

SALTUS_INLINE bool any(I mask) {
#if defined(__AVX512F__)
  return __builtin_ia32_ptestmq512(mask, mask, -1) != 0;
#else
  long long all = 0;
  for (int l = 0; l < W; ++l) all |= mask[l];
  return all != 0;
#endif
}

SALTUS_INLINE I finite(V a) { return a - a == 0.0; }

// 1 / a for normal a, to the last bit or two. Where the machine guesses it to 2^-14, two Newton steps, which double the
// digits, are several times cheaper than a division, and may overlap.
SALTUS_INLINE V reciprocal(V a) {
#if defined(__AVX512F__)
  const V y = __builtin_ia32_rcp14pd512_mask(a, V{}, -1), e = 1.0 - a * y, once = y + y * e;
  return once + once * (e * e);
#else
  return 1.0 / a;
#endif
}

// For normal a, likewise: a y (1 - e)^(-1/2) with a guess y of a^(-1/2) and e = 1 - a y^2 below 2^-13, to e^3.
SALTUS_INLINE V square_root(V a) {
#if defined(__AVX512F__)
  const V y = __builtin_ia32_rsqrt14pd512_mask(a, V{}, -1), root = a * y, e = 1.0 - root * y;
  return root + root * (e * ((0.3125 * e + 0.375) * e + 0.5));
#elif defined(__AVX__)
  return __builtin_ia32_sqrtpd256(a);
#else
  for (int l = 0; l < W; ++l) a[l] = __builtin_sqrt(a[l]);
  return a;
#endif
}

// e^x for x <= 700, 0 below -708 (where the result would be subnormal); NaN stays NaN.
// x = k ln 2 + r, |r| <= ln(2)/2; e^r by its Taylor series, remainder below 5e-18.
SALTUS_INLINE V exponential(V x) {
  const double magic = 0x1.8p52;  // adding it rounds to an integer, left in the low bits
  V shifted = x * 1.4426950408889634 + magic;
  V k = shifted - magic;
  V r = (x - k * 0x1.62e42fefa3800p-1) - k * 0x1.ef35793c76730p-45;
  V r2 = r * r, r4 = r2 * r2;
  V a = (r * (1.0 / 6.0) + 0.5) * r2 + (r + 1.0);
  V b = (r * (1.0 / 5040.0) + 1.0 / 720.0) * r2 + (r * (1.0 / 120.0) + 1.0 / 24.0);
  V c = (r * (1.0 / 39916800.0) + 1.0 / 3628800.0) * r2 + (r * (1.0 / 362880.0) + 1.0 / 40320.0);
  V d = r * (1.0 / 6227020800.0) + 1.0 / 479001600.0;
  V e = ((d * r4 + c) * r4 + b) * r4 + a;
  I scale = (reinterpret_cast<I>(shifted) + 1023) << 52;
  e = e * reinterpret_cast<V>(scale);
  return select(x < -708.0, V{}, e);
}

// log x for normal x; -inf for 0 and subnormal x.
// x = 2^k (1 + f), sqrt(1/2) <= 1 + f < sqrt(2); log(1 + f) = 2 artanh(f / (2 + f)), remainder below 1e-18.
SALTUS_INLINE V logarithm(V x) {
  // Unsigned and biased by 2048: shifts of signed 64-bit lanes are slow before AVX-512.
  typedef unsigned long long Bits __attribute__((vector_size(8 * W)));
  const unsigned long long root_half = 0x3fe6a09e667f3bcd, bias = 1ULL << 63;
  Bits bits = reinterpret_cast<Bits>(x);
  Bits k = (bits + (bias - root_half)) >> 52;
  V exponent = reinterpret_cast<V>(k | 0x4330000000000000ULL) - (0x1p52 + 2048.0);
  V f = reinterpret_cast<V>(bits - ((k - 2048ULL) << 52)) - 1.0;
  V s = f * reciprocal(2.0 + f);
  V z = s * s, z2 = z * z, z4 = z2 * z2;
  V a = z * (2.0 / 5.0) + 2.0 / 3.0, b = z * (2.0 / 9.0) + 2.0 / 7.0;
  V c = z * (2.0 / 13.0) + 2.0 / 11.0, d = z * (2.0 / 17.0) + 2.0 / 15.0, e = z * (2.0 / 21.0) + 2.0 / 19.0;
  V series = ((e * z2 + d) * z2 + c) * z4 + (b * z2 + a);
  V result = exponent * 0x1.62e42fefa3800p-1 + (2.0 * s + (s * z * series + exponent * 0x1.ef35793c76730p-45));
  return select(x < 0x1p-1022, splat(-__builtin_inf()), select(x == x, result, x));
}

template <int S>
SALTUS_INLINE void exchange(V& a, V& b) {
  I low{}, high{};
  for (int l = 0; l < W; ++l) {
    low[l] = l & S ? W + l - S : l;
    high[l] = l & S ? W + l : l + S;
  }
  V first = __builtin_shuffle(a, b, low), second = __builtin_shuffle(a, b, high);
  a = first;
  b = second;
}

// r[i][l] <-> r[l][i].
SALTUS_INLINE void transpose(V (&r)[W]) {
#pragma GCC unroll 8
  for (int i = 0; i < W; ++i)
    if (!(i & 1)) exchange<1>(r[i], r[i + 1]);
  if constexpr (W > 2) {
#pragma GCC unroll 8
    for (int i = 0; i < W; ++i)
      if (!(i & 2)) exchange<2>(r[i], r[i + 2]);
  }
  if constexpr (W > 4) {
#pragma GCC unroll 8
    for (int i = 0; i < W; ++i)
      if (!(i & 4)) exchange<4>(r[i], r[i + 4]);
  }
}

}  // namespace saltus::SALTUS_NS
