// The one recursion, step by step, on the lanes of one block: twins of src/saltus/filters/steps.py.
//
// A block holds, per mode, a record [x (n) | P packed by rows of its lower triangle (n (n + 1) / 2)]. N and M are the
// sizes when known to the compiler, 0 when they are known at run time only. E is the element of a model matrix:
// double, common to all lanes, or V, one per lane. Nothing here calls the host: the same text compiles for any scalar.
#pragma once

#include "lanes.hpp"

namespace saltus::SALTUS_NS {

#ifndef SALTUS_UNROLL
#define SALTUS_UNROLL 13
#endif

// Share of a variance that is rounding, for each of the subtractions it went through.
inline constexpr double kRounding = 0x1p-51;

// Share of two means by which rounding alone may part them.
inline constexpr double kBlur = 0x1p-50;

// Share of a variance below which what a measurement left of it, or of its own, is the square of rounding.
inline constexpr double kEmpty = 0x1p-98;

// A variance below it is none: its reciprocal would overflow. Twin of linalg.NOTHING.
inline constexpr double kNothing = 0x1p-1000;

// Keeps the moments of a mode of probability zero defined, and touches nothing else.
inline constexpr double kFloor = 1e-290;

// f(0), ..., f(n - 1), unrolled when N is small.
template <int N, class F>
SALTUS_INLINE void each(int n, F f) {
  if constexpr (N > 0 && N <= SALTUS_UNROLL) {
#pragma GCC unroll 13
    for (int i = 0; i < N; ++i) f(i);
  } else {
    const int end = N > 0 ? N : n;
#pragma GCC unroll 1
    for (int i = 0; i < end; ++i) f(i);
  }
}

// f(0), ..., f(i): a constant trip count with a condition, which the compiler can unroll before it knows i.
template <int N, class F>
SALTUS_INLINE void upto(int i, F f) {
  if constexpr (N > 0 && N <= SALTUS_UNROLL) {
#pragma GCC unroll 13
    for (int j = 0; j < N; ++j)
      if (j <= i) f(j);
  } else {
#pragma GCC unroll 1
    for (int j = 0; j <= i; ++j) f(j);
  }
}

// f(i), ..., f(n - 1).
template <int N, class F>
SALTUS_INLINE void from(int i, int n, F f) {
  if constexpr (N > 0 && N <= SALTUS_UNROLL) {
#pragma GCC unroll 13
    for (int j = 0; j < N; ++j)
      if (j >= i) f(j);
  } else {
    const int end = N > 0 ? N : n;
#pragma GCC unroll 1
    for (int j = i; j < end; ++j) f(j);
  }
}

// The sum of a(k) b(k) over first <= k < last <= N, in four sums that do not wait for
// each other.
template <int N, class A, class B>
SALTUS_INLINE V dot(int first, int last, A a, B b) {
  V sum[4] = {};
  if constexpr (N > 0 && N <= SALTUS_UNROLL) {
#pragma GCC unroll 13
    for (int k = 0; k < N; ++k)
      if (k >= first && k < last) sum[k & 3] += a(k) * b(k);
  } else {
    int k = first;
#pragma GCC unroll 1
    for (; k + 4 <= last; k += 4) {
      sum[0] += a(k) * b(k);
      sum[1] += a(k + 1) * b(k + 1);
      sum[2] += a(k + 2) * b(k + 2);
      sum[3] += a(k + 3) * b(k + 3);
    }
#pragma GCC unroll 1
    for (; k < last; ++k) sum[0] += a(k) * b(k);
  }
  return (sum[0] + sum[1]) + (sum[2] + sum[3]);
}

// Registers when the size is known (L > 0), a piece of `heap` otherwise.
template <int L>
struct Local {
  V a[L];
  SALTUS_INLINE Local(V*&, int) {}
  SALTUS_INLINE V& operator[](int i) { return a[i]; }
};
template <>
struct Local<0> {
  V* a;
  SALTUS_INLINE Local(V*& heap, int size) : a(heap) { heap += size; }
  SALTUS_INLINE V& operator[](int i) { return a[i]; }
};

SALTUS_INLINE constexpr int triangle(int n) { return n * (n + 1) / 2; }
SALTUS_INLINE constexpr int packed(int i, int j) { return i >= j ? triangle(i) + j : triangle(j) + i; }

// A model matrix by mode: mode j has its elements at data + which[j] * core.
template <class E>
struct ByMode {
  const E* data;
  const int* which;
  int core;
  SALTUS_INLINE const E* operator[](int mode) const { return data + which[mode] * core; }
  SALTUS_INLINE bool present() const { return data != nullptr; }
};

// Weights mu[i * size + j] = trans_ij P_i / Q_j of one fibre of modes, and its law advanced to Q in place.
template <class E>
SALTUS_INLINE void mixing_weights(V* law, int stride, int size, const E* trans, bool logs, V* mu) {
  V top{};
  if (logs) {
    top = law[0];
    for (int i = 1; i < size; ++i) top = maximum(top, law[i * stride]);
    top = select(top > -__builtin_inf(), top, V{});
  }
  V* p = mu + size * size;
  for (int i = 0; i < size; ++i) p[i] = logs ? exponential(law[i * stride] - top) : law[i * stride];
  for (int j = 0; j < size; ++j) {
    V q{}, total{};
    for (int i = 0; i < size; ++i) {
      V joint = p[i] * trans[i * size + j];
      q += joint;
      mu[i * size + j] = joint + kFloor;
      total += joint + kFloor;
    }
    V inverse = reciprocal(total);
    for (int i = 0; i < size; ++i) mu[i * size + j] *= inverse;
    law[j * stride] = logs ? logarithm(q) + top : q;
  }
}

// The same for a fibre of two modes, kept in registers.
template <class E, bool Logs>
SALTUS_INLINE void pair_weights(V& a, V& b, const E* trans, V (&mu)[4]) {
  V top{}, p = a, q = b;
  if constexpr (Logs) {
    top = maximum(a, b);
    top = select(top > -__builtin_inf(), top, V{});
    p = exponential(p - top), q = exponential(q - top);
  }
  const V p0 = p * trans[0], p1 = p * trans[1], q0 = q * trans[2], q1 = q * trans[3];
  a = p0 + q0, b = p1 + q1;
  if constexpr (Logs) a = logarithm(a) + top, b = logarithm(b) + top;
  const V x0 = p0 + kFloor, x1 = p1 + kFloor, y0 = q0 + kFloor, y1 = q1 + kFloor;
  const V first = reciprocal(x0 + y0), second = reciprocal(x1 + y1);
  mu[0] = x0 * first, mu[1] = x1 * second, mu[2] = y0 * first, mu[3] = y1 * second;
}

// How far two means are apart: not at all, where rounding may have parted them, for the square of that is no variance.
SALTUS_INLINE V apart(V a, V b) {
  const V gap = a - b;
  return select(magnitude(gap) > kBlur * magnitude(a), gap, V{});
}

// Moment matching of two modes, in place: R_j = mu_0j P_0 + mu_1j P_1 + mu_0j mu_1j (x_0 - x_1)(x_0 - x_1)'.
template <int N>
SALTUS_INLINE void mix_pair(V* a, V* b, const V (&mu)[4], int n, V* heap) {
  const V a0 = mu[0], a1 = mu[1], b0 = mu[2], b1 = mu[3], c0 = a0 * b0, c1 = a1 * b1;
  Local<N> gap(heap, n);
  each<N>(n, [&](int i) SALTUS_LAMBDA {
    const V x = a[i], y = b[i];
    gap[i] = apart(x, y);
    a[i] = a0 * x + b0 * y;
    b[i] = a1 * x + b1 * y;
  });
  each<N>(n, [&](int i) SALTUS_LAMBDA {
    upto<N>(i, [&](int j) SALTUS_LAMBDA {
      const int k = n + packed(i, j);
      const V P = a[k], R = b[k], spread = gap[i] * gap[j];
      a[k] = a0 * P + (b0 * R + c0 * spread);
      b[k] = a1 * P + (b1 * R + c1 * spread);
    });
  });
}

// Moment matching of one fibre of any size: R_j = sum_i mu_ij [P_i + (x_i - x_j)(x_i - x_j)'].
template <int N>
SALTUS_INLINE void mix_fibre(V* first, long stride, int size, const V* mu, int n, V* heap) {
  const int record = n + triangle(n);
  V* old = heap;
  heap += size * record;
  for (int i = 0; i < size; ++i)
    for (int k = 0; k < record; ++k) old[i * record + k] = first[i * stride + k];
  for (int j = 0; j < size; ++j) {
    V* free = heap;
    Local<N> x(free, n), gap(free, n);
    Local<triangle(N)> P(free, triangle(n));
    each<N>(n, [&](int k) SALTUS_LAMBDA { x[k] = V{}; });
    each<N>(n, [&](int k) SALTUS_LAMBDA { upto<N>(k, [&](int l) SALTUS_LAMBDA { P[packed(k, l)] = V{}; }); });
    for (int i = 0; i < size; ++i)
      each<N>(n, [&](int k) SALTUS_LAMBDA { x[k] += mu[i * size + j] * old[i * record + k]; });
    for (int i = 0; i < size; ++i) {
      const V weight = mu[i * size + j];
      const V* source = old + i * record;
      each<N>(n, [&](int k) SALTUS_LAMBDA { gap[k] = apart(source[k], x[k]); });
      each<N>(n, [&](int k) SALTUS_LAMBDA {
        const V scaled = weight * gap[k];
        upto<N>(k, [&](int l) SALTUS_LAMBDA {
          P[packed(k, l)] += weight * source[n + packed(k, l)] + scaled * gap[l];
        });
      });
    }
    V* target = first + j * stride;
    each<N>(n, [&](int k) SALTUS_LAMBDA { target[k] = x[k]; });
    each<N>(n, [&](int k) SALTUS_LAMBDA {
      upto<N>(k, [&](int l) SALTUS_LAMBDA { target[n + packed(k, l)] = P[packed(k, l)]; });
    });
  }
}

// One chain of two modes. Apart from logs, whose constants would fill the registers of the loop.
template <int N, class E, bool Logs>
__attribute__((noinline)) void mix_pairs(V* state, V* law, int size_n, int outer, int inner, const E* trans, V* heap) {
  const int n = N > 0 ? N : size_n;
  const long record = n + triangle(n), step = inner * record;
  for (int o = 0; o < outer; ++o, state += step, law += inner)
    for (int i = 0; i < inner; ++i, state += record, ++law) {
      V mu[4];
      pair_weights<E, Logs>(law[0], law[inner], trans, mu);
      mix_pair<N>(state, state + step, mu, n, heap);
    }
}

// One chain: modes are outer x size x inner, the middle axis is mixed. `law` is P(modes), or its logarithm.
template <int N, class E>
void mix(V* state, V* law, int size_n, int outer, int size, int inner, const E* trans, bool logs, V* heap) {
  if (size == 2)
    return (logs ? mix_pairs<N, E, true> : mix_pairs<N, E, false>)(state, law, size_n, outer, inner, trans, heap);
  const int n = N > 0 ? N : size_n;
  const long record = n + triangle(n);
  for (int o = 0; o < outer; ++o)
    for (int i = 0; i < inner; ++i) {
      const int at = o * size * inner + i;
      V* mu = heap;
      mixing_weights(law + at, inner, size, trans, logs, mu);
      mix_fibre<N>(state + at * record, inner * record, size, mu, n, heap + size * size + size);
    }
}

// P = L D L' in place of the lower triangle of P, packed by rows: L, whose diagonal is of ones, below it, D on it. Where
// rounding has left nothing of a variance its column is zero: L D L' is positive semidefinite whatever P is.
template <int N, class P>
SALTUS_INLINE void factor_known(int size_n, P& a, V* heap) {
  const int n = N > 0 ? N : size_n;
  Local<N> least(heap, n), column(heap, n);
  each<N>(n, [&](int j) SALTUS_LAMBDA { least[j] = maximum(a[packed(j, j)] * (kRounding * n), splat(kNothing)); });
  each<N>(n, [&](int j) SALTUS_LAMBDA {
    const V pivot = a[packed(j, j)];
    const I dead = pivot <= least[j];
    const V one_over = select(dead, V{}, reciprocal(pivot));
    a[packed(j, j)] = select(dead, 0.0 * pivot, pivot);  // what has overflowed is not nothing: it stays none
    from<N>(j + 1, n, [&](int i) SALTUS_LAMBDA {
      column[i] = a[packed(i, j)];
      a[packed(i, j)] = column[i] * one_over;
      // Its square first: the next pivot waits for the reciprocal alone.
      if (i == j + 1) a[packed(i, i)] -= column[i] * column[i] * one_over;
    });
    from<N>(j + 2, n, [&](int i) SALTUS_LAMBDA {
      from<N>(j + 1, n, [&](int k) SALTUS_LAMBDA {
        if (k <= i) a[packed(i, k)] -= a[packed(i, j)] * column[k];
      });
    });
  });
}

// row_c = sum_k f_k L_kc of what `factor` left, L with ones on its diagonal.
template <int N, class E, class P>
SALTUS_INLINE void times_root_known(int size_n, const E* f, P& L, V* row) {
  const int n = N > 0 ? N : size_n;
  each<N>(n, [&](int c) SALTUS_LAMBDA {
    V sum = splat(f[c]);
    from<N>(c + 1, n, [&](int k) SALTUS_LAMBDA { sum += L[packed(k, c)] * f[k]; });
    row[c] = sum;
  });
}

// P = X W X' + Q, of n rows of X over `wide` sources of variance W; Q, with rows of `stride`, is absent where null.
template <int N, int WIDE, class E>
SALTUS_INLINE void squares_known(int n, int size_wide, const V* x, const V* weight, const E* Q, int stride, V* P,
                                 V* heap) {
  const int wide = WIDE > 0 ? WIDE : size_wide;
  const auto with = [&](int i, int j, V sum) SALTUS_LAMBDA { P[packed(i, j)] = Q ? Q[i * stride + j] + sum : sum; };
  if constexpr (N > 0) {
    Local<WIDE> row(heap, wide);
    each<N>(n, [&](int i) SALTUS_LAMBDA {
      each<WIDE>(wide, [&](int k) SALTUS_LAMBDA { row[k] = x[i * wide + k] * weight[k]; });
      upto<N>(i, [&](int j) SALTUS_LAMBDA {
        V sum{};
        each<WIDE>(wide, [&](int k) SALTUS_LAMBDA { sum += row[k] * x[j * wide + k]; });
        with(i, j, sum);
      });
    });
  } else {
    // Two rows by two: four sums that do not wait for each other, and two products for every load.
    Local<WIDE> a(heap, wide), b(heap, wide);
#pragma GCC unroll 1
    for (int i = 0; i < n; i += 2) {
      const V *x0 = x + i * wide, *x1 = i + 1 < n ? x0 + wide : x0;
      each<WIDE>(wide, [&](int k) SALTUS_LAMBDA { a[k] = x0[k] * weight[k], b[k] = x1[k] * weight[k]; });
#pragma GCC unroll 1
      for (int j = 0; j <= i; j += 2) {
        const V *y0 = x + j * wide, *y1 = j + 1 < n ? y0 + wide : y0;
        V s00{}, s01{}, s10{}, s11{};
        each<WIDE>(wide, [&](int k) SALTUS_LAMBDA {
          s00 += a[k] * y0[k], s01 += a[k] * y1[k];
          s10 += b[k] * y0[k], s11 += b[k] * y1[k];
        });
        with(i, j, s00);
        if (j < i) with(i, j + 1, s01);
        if (i + 1 == n) continue;
        with(i + 1, j, s10);
        with(i + 1, j + 1, s11);
      }
    }
  }
}

// A size that the steps do not know is still known to the loops that do most of their work, up to kWidest.
inline constexpr int kWidest = 13;

template <int FROM, class F>
SALTUS_INLINE void by_size(int size, F f) {
  if constexpr (FROM > kWidest)
    f.template operator()<0>();
  else if (size == FROM)
    f.template operator()<FROM>();
  else
    by_size<FROM + 1>(size, f);
}

template <int N>
__attribute__((noinline)) void factor_apart(int n, V* a, V* heap) {
  factor_known<N>(n, a, heap);
}

template <int N, class E>
__attribute__((noinline)) void times_root_apart(int n, int rows, const E* f, int stride, const V* L, V* out, int wide) {
#pragma GCC unroll 1
  for (int i = 0; i < rows; ++i) times_root_known<N>(n, f + i * stride, L, out + i * wide);
}

template <int WIDE, class E>
__attribute__((noinline)) void squares_apart(int n, int wide, const V* x, const V* weight, const E* Q, int stride, V* P,
                                             V* heap) {
  squares_known<0, WIDE>(n, wide, x, weight, Q, stride, P, heap);
}

template <int N, class P>
SALTUS_INLINE void factor(int n, P& a, V* heap) {
  if constexpr (N > 0)
    factor_known<N>(n, a, heap);
  else
    by_size<7>(n, [&]<int SIZE>() SALTUS_LAMBDA { factor_apart<(SIZE < 10 ? SIZE : 0)>(n, &a[0], heap); });
}

// The same for `rows` rows of f, `stride` apart, into rows of `out`, `wide` apart.
template <int N, int ROWS, class E, class P>
SALTUS_INLINE void times_root(int n, int rows, const E* f, int stride, P& L, V* out, int wide) {
  if constexpr (N > 0)
    each<ROWS>(rows, [&](int i) SALTUS_LAMBDA { times_root_known<N>(n, f + i * stride, L, out + i * wide); });
  else
    by_size<7>(n, [&]<int SIZE>() SALTUS_LAMBDA {
      times_root_apart<(SIZE < 10 ? SIZE : 0)>(n, rows, f, stride, &L[0], out, wide);
    });
}

template <int N, int WIDE, class E>
SALTUS_INLINE void squares(int n, int wide, const V* x, const V* weight, const E* Q, int stride, V* P, V* heap) {
  if constexpr (N > 0)
    squares_known<N, WIDE>(n, wide, x, weight, Q, stride, P, heap);
  else
    by_size<7>(wide, [&]<int SIZE>() SALTUS_LAMBDA { squares_apart<SIZE>(n, wide, x, weight, Q, stride, P, heap); });
}

// x <- F x + b, P <- (F L) D (F L)' + Q for every mode, P = L D L'.
template <int N, class E>
void propagate(V* state, int size_n, int modes, ByMode<E> F, ByMode<E> b, ByMode<E> Q, V* heap) {
  const int n = N > 0 ? N : size_n;
  const int record = n + triangle(n);
  for (int mode = 0; mode < modes; ++mode, state += record) {
    V* free = heap;
    const E *f = F[mode], *q = Q[mode];
    Local<triangle(N)> P(free, triangle(n));
    Local<N * N> root(free, n * n);
    Local<N> x(free, n), D(free, n);
    each<N>(n, [&](int i) SALTUS_LAMBDA {
      x[i] = state[i];
      upto<N>(i, [&](int j) SALTUS_LAMBDA { P[packed(i, j)] = state[n + packed(i, j)]; });
    });
    factor<N>(n, P, free);
    each<N>(n, [&](int i) SALTUS_LAMBDA {
      V moved = b.present() ? splat(b[mode][i]) : V{};
      each<N>(n, [&](int k) SALTUS_LAMBDA { moved += x[k] * f[i * n + k]; });
      state[i] = moved;
      D[i] = P[packed(i, i)];
    });
    times_root<N, N>(n, n, f, n, P, &root[0], n);
    squares<N, N>(n, n, &root[0], &D[0], q, n, state + n, free);
  }
}

// sum_j P_j x_j and sum_j P_j [P_j + (x_j - mean)(x_j - mean)'] into out = [mean | packed covariance].
template <int N>
void collapse(const V* state, const V* probs, int size_n, int modes, V* out, V* heap) {
  const int n = N > 0 ? N : size_n;
  const int record = n + triangle(n);
  Local<N> x(heap, n), gap(heap, n);
  Local<triangle(N)> P(heap, triangle(n));
  each<N>(n, [&](int i) SALTUS_LAMBDA {
    x[i] = V{};
    upto<N>(i, [&](int j) SALTUS_LAMBDA { P[packed(i, j)] = V{}; });
  });
  for (int mode = 0; mode < modes; ++mode)
    each<N>(n, [&](int i) SALTUS_LAMBDA { x[i] += probs[mode] * state[mode * record + i]; });
  for (int mode = 0; mode < modes; ++mode) {
    const V* source = state + mode * record;
    const V weight = probs[mode];
    each<N>(n, [&](int i) SALTUS_LAMBDA { gap[i] = source[i] - x[i]; });
    each<N>(n, [&](int i) SALTUS_LAMBDA {
      const V scaled = weight * gap[i];
      upto<N>(i, [&](int j) SALTUS_LAMBDA {
        P[packed(i, j)] += weight * source[n + packed(i, j)] + scaled * gap[j];
      });
    });
  }
  each<N>(n, [&](int i) SALTUS_LAMBDA {
    out[i] = x[i];
    upto<N>(i, [&](int j) SALTUS_LAMBDA { out[n + packed(i, j)] = P[packed(i, j)]; });
  });
}

}  // namespace saltus::SALTUS_NS
