// What a measurement says of every mode and does to it: twins of measure, joint, condition and mixture_nis in
// src/saltus/filters/steps.py.
#pragma once

#include "step.hpp"

namespace saltus::SALTUS_NS {

// Whether an innovation variance s, of `whole` before those before it, is more than rounding.
SALTUS_INLINE I certain(V s, V whole) { return s > maximum(kEmpty * whole, splat(kNothing)); }
SALTUS_INLINE bool certain(double s, double whole) { return s > kEmpty * whole && s > kNothing; }

// Per mode in `report`: [d2 | 1 / det S | pivots (m) | nu (m) | S packed].
SALTUS_INLINE constexpr int report_size(int m) { return 2 + 2 * m + triangle(m); }

// State x+ and measurement y of one mode, as rows over independent sources: those of the state before (n), of variance
// D, and those of the noise (m). `Own`: source n + a is the noise of component a given those before it, with a one in
// its row of y; the noise enters y alone.
template <int N, int M>
struct Deviations {
  Local<N * (N + M)> x;
  Local<M * (N + M)> y;
  Local<N + M> weight, c;
  Local<M> nu;
  SALTUS_INLINE Deviations(V*& heap, int n, int m)
      : x(heap, n * (n + m)), y(heap, m * (n + m)), weight(heap, n + m), c(heap, n + m), nu(heap, m) {}
};

// S = Y Y' into the report, with rows and columns of the unit matrix for what was not seen.
template <int N, int M, int WIDE, bool Own>
SALTUS_INLINE void innovation(int n, int m, int wide, Deviations<N, M>& by, const V* on, V* report) {
  each<M>(m, [&](int back) SALTUS_LAMBDA {
    const int a = m - 1 - back;  // the first last: its weighted row is the first that the sweep needs
    const int last = Own && N > 0 ? n + a + 1 : wide;  // columns that may hold anything
    report[2 + m + a] = by.nu[a];
    from<WIDE>(0, wide, [&](int k) SALTUS_LAMBDA {
      if (k < last) by.c[k] = by.y[a * wide + k] * by.weight[k];
    });
    upto<M>(a, [&](int b) SALTUS_LAMBDA {
      const V sum = dot<WIDE>(
          0, Own && N > 0 ? n + b + 1 : wide, [&](int k) SALTUS_LAMBDA { return by.c[k]; },
          [&](int k) SALTUS_LAMBDA { return by.y[b * wide + k]; });
      report[2 + 2 * m + packed(a, b)] = a == b ? select(on[a] != 0.0, sum, splat(1.0)) : sum * (on[a] * on[b]);
    });
  });
}

// r -= g c', g = r c W / s, and the same of what goes with the row; `filled` says how much of r is not zero.
template <int WIDE>
SALTUS_INLINE V swept(int filled, int last, V* r, const V* weighted, const V* c, V share_of) {
  const V share = share_of * dot<WIDE>(
                                 0, filled, [&](int k) SALTUS_LAMBDA { return r[k]; },
                                 [&](int k) SALTUS_LAMBDA { return weighted[k]; });
  from<WIDE>(0, last, [&](int k) SALTUS_LAMBDA {
    if (k < last) r[k] = k < filled ? r[k] - share * c[k] : -share * c[k];
  });
  return share;
}

// Take what was measured, one component after the other, out of the components after it and, if `write`, of the state.
// With c the row in hand, nu its innovation and s = c c':
//
//   K = X c' / s,   x += K nu,   X -= K c,   and so for the rows of y that are left.
//
// Gram-Schmidt on the rows of y, in which no S is inverted: X X' stays a sum of squares whatever was subtracted. Says
// d2, 1 / det S and the pivots s in the report; returns the lanes in which nothing but rounding was left of a component
// that was seen.
template <int N, int M, int WIDE, bool Own>
SALTUS_INLINE I sweep(int n, int m, int wide, Deviations<N, M>& by, const V* on, V* state, V* report, bool write) {
  V d2{}, inverse_det = splat(1.0);
  I bad{};
  each<M>(m, [&](int a) SALTUS_LAMBDA {
    V *row = &by.y[a * wide], *c = &by.c[0];
    const V whole = report[2 + 2 * m + packed(a, a)];
    const int last = Own && N > 0 ? n + a + 1 : wide;
    V s = whole;
    if (a > 0) {
      from<WIDE>(0, wide, [&](int k) SALTUS_LAMBDA {
        if (k < last) c[k] = row[k] * by.weight[k];
      });
      const V sum = dot<WIDE>(
          0, last, [&](int k) SALTUS_LAMBDA { return c[k]; }, [&](int k) SALTUS_LAMBDA { return row[k]; });
      s = select(on[a] != 0.0, sum, splat(1.0));
    }
    bad |= ~certain(s, whole);
    const V one_over = reciprocal(s), share_of = one_over * on[a], nu = by.nu[a];
    report[2 + a] = s;
    inverse_det *= one_over;
    d2 += nu * share_of * nu;
    from<M>(a + 1, m, [&](int b) SALTUS_LAMBDA { by.nu[b] -= nu * swept<WIDE>(last, last, &by.y[b * wide], c, row, share_of); });
    if (!write) return;
    if constexpr (N > 0)
      each<N>(n, [&](int i) SALTUS_LAMBDA {
        const int filled = !Own ? wide : a == 0 ? i + 1 : n + a;
        state[i] += nu * swept<WIDE>(filled, last, &by.x[i * wide], c, row, share_of);
      });
    else
#pragma GCC unroll 2
      for (int i = 0; i < n; ++i) state[i] += nu * swept<WIDE>(wide, wide, &by.x[i * wide], c, row, share_of);
  });
  report[0] = d2;
  report[1] = inverse_det;
  return bad;
}

// What is known exactly has no variance: what rounding left of P would be believed by the next exact measurement.
template <int N, int M, int WIDE>
SALTUS_INLINE void forget_rounding(int n, int wide, Deviations<N, M>& by, const V* P) {
  each<N>(n, [&](int i) SALTUS_LAMBDA {
    V left{};
    each<WIDE>(wide, [&](int k) SALTUS_LAMBDA { left += by.x[i * wide + k] * by.weight[k] * by.x[i * wide + k]; });
    const V keep = select(left <= kEmpty * P[packed(i, i)], V{}, splat(1.0));
    each<WIDE>(wide, [&](int k) SALTUS_LAMBDA { by.x[i * wide + k] *= keep; });
  });
}

// Innovation and sweep and, if `write`, the squares of what is left.
template <int N, int M, int WIDE, bool Own, class E>
SALTUS_INLINE I conditioned_known(int n, int m, int wide, Deviations<N, M>& by, const V* on, V* state, V* report,
                                  const E* Q, int stride, V* heap, bool write) {
  innovation<N, M, WIDE, Own>(n, m, wide, by, on, report);
  const I bad = sweep<N, M, WIDE, Own>(n, m, wide, by, on, state, report, write);
  if (!write) return bad;
  if constexpr (Own) {
    I exact{};
    each<M>(m, [&](int a) SALTUS_LAMBDA { exact |= by.weight[n + a] <= kEmpty * report[2 + 2 * m + packed(a, a)]; });
    if (any(exact)) forget_rounding<N, M, WIDE>(n, wide, by, state + n);
  }
  squares_known<N, WIDE>(n, wide, &by.x[0], &by.weight[0], Q, stride, state + n, heap);
  return bad;
}

template <int WIDE, bool Own, class E>
__attribute__((noinline)) I conditioned_apart(int n, int m, int wide, Deviations<0, 0>& by, const V* on, V* state,
                                              V* report, const E* Q, int stride, V* heap, bool write) {
  return conditioned_known<0, 0, WIDE, Own>(n, m, wide, by, on, state, report, Q, stride, heap, write);
}

template <int N, int M, bool Own, class E>
SALTUS_INLINE I conditioned(int n, int m, Deviations<N, M>& by, const V* on, V* state, V* report, const E* Q, int stride,
                            V* heap, bool write) {
  const int wide = n + m;
  if constexpr (N > 0) return conditioned_known<N, M, N + M, Own>(n, m, wide, by, on, state, report, Q, stride, heap, write);
  I bad{};
  if constexpr (N == 0)
    by_size<7>(wide, [&]<int WIDE>() SALTUS_LAMBDA {
      bad = conditioned_apart<WIDE, Own>(n, m, wide, by, on, state, report, Q, stride, heap, write);
    });
  return bad;
}

// B of R = B C B', with its C as weights; most noises are independent, and have none.
template <int N, int M, class E>
SALTUS_INLINE void noise_rows(int n, int m, const E* r, Deviations<N, M>& by, V* heap) {
  const int wide = n + m;
  I related{};
  each<M>(m, [&](int a) SALTUS_LAMBDA {
    by.weight[n + a] = splat(r[a * m + a]);
    upto<M>(a - 1, [&](int b) SALTUS_LAMBDA {
      by.y[a * wide + n + b] = splat(r[a * m + b]);
      related |= by.y[a * wide + n + b] != 0.0;
    });
    by.y[a * wide + n + a] = splat(1.0);
    if constexpr (N == 0)
      for (int b = a + 1; b < m; ++b) by.y[a * wide + n + b] = V{};
  });
  if (!any(related)) return;
  Local<triangle(M)> B(heap, triangle(m));
  each<M>(m, [&](int a) SALTUS_LAMBDA {
    upto<M>(a, [&](int b) SALTUS_LAMBDA { B[packed(a, b)] = splat(r[a * m + b]); });
  });
  factor<M>(m, B, heap);
  each<M>(m, [&](int a) SALTUS_LAMBDA {
    by.weight[n + a] = B[packed(a, a)];
    upto<M>(a - 1, [&](int b) SALTUS_LAMBDA { by.y[a * wide + n + b] = B[packed(a, b)]; });
  });
}

// Measure every mode and, if `write`, condition it: z = H x + v, P = L D L', R = B C B'.
//
//   nu = z - H x - d,   Y = [H L  B],   X = [L  0],   W = (D, C);   P+ = X W X' after the sweep
template <int N, int M, class E>
I measure(V* state, int size_n, int size_m, int modes, ByMode<E> H, ByMode<E> d, ByMode<E> R, const V* z, const V* on,
          V* report, V* heap, bool write) {
  const int n = N > 0 ? N : size_n, m = M > 0 ? M : size_m, wide = n + m;
  const int record = n + triangle(n);
  I bad{};
  for (int mode = 0; mode < modes; ++mode, state += record, report += report_size(m)) {
    V *free = heap, *P = state + n;
    const E* h = H[mode];
    Local<triangle(N)> L(free, triangle(n));
    Deviations<N, M> by(free, n, m);
    each<N>(n, [&](int i) SALTUS_LAMBDA {
      upto<N>(i, [&](int j) SALTUS_LAMBDA { L[packed(i, j)] = P[packed(i, j)]; });
    });
    factor<N>(n, L, free);
    each<N>(n, [&](int i) SALTUS_LAMBDA { by.weight[i] = L[packed(i, i)]; });
    each<M>(m, [&](int a) SALTUS_LAMBDA {
      V residual = z[a];
      if (d.present()) residual -= d[mode][a];
      each<N>(n, [&](int k) SALTUS_LAMBDA { residual -= state[k] * h[a * n + k]; });
      by.nu[a] = residual * on[a];
    });
    times_root<N, M>(n, m, h, n, L, &by.y[0], wide);
    noise_rows<N, M, E>(n, m, R[mode], by, free);
    if (write)
      each<N>(n, [&](int i) SALTUS_LAMBDA {
        upto<N>(i, [&](int k) SALTUS_LAMBDA { by.x[i * wide + k] = k == i ? splat(1.0) : L[packed(i, k)]; });
        if (N == 0)
          for (int k = i + 1; k < wide; ++k) by.x[i * wide + k] = V{};
      });
    bad |= conditioned<N, M, true, double>(n, m, by, on, state, report, nullptr, 0, free, write);
  }
  return bad;
}

// Move and condition every mode at once, where what is measured is the part y of s = (x, y), without noise of its own.
// `Inside`, y is in the state, which is s: Phi = A, C is its last m rows, and `known` is not read. Otherwise y was
// `known` before the interval and only x is in the state: Phi = [A D; C E], with known inputs D y and E y. The noises
// e of s and f of y are e = M u + v, f = M_f u, cov u = I, cov v = Q: `noise` is [Q | cov(e, f) | M] by rows of s.
//
//   x~ = A x + b,  nu = z - C x - d,  X = [A L  M],  Y = [C L  M_f],  W = (D, 1),  P = L D L';  P+ = X W X' + Q
//
// What the measurement tells exactly is left with a variance of rounding's square.
template <int N, int M, class E, bool Inside>
I advance(V* state, int size_n, int size_m, int modes, ByMode<E> Phi, ByMode<E> b, ByMode<E> noise, const V* known,
          const V* z, const V* on, V* report, V* heap) {
  if constexpr (Inside && N > 0 && N <= M) return I{};  // there is no such state
  const int n = N > 0 ? N : size_n, m = M > 0 ? M : size_m, wide = n + m;
  const int all = Inside ? n : n + m, y = all - m;  // the size of s, and where y begins in it
  const int stride = all + 2 * m, record = n + triangle(n);
  I bad{};
  for (int mode = 0; mode < modes; ++mode, state += record, report += report_size(m)) {
    V *free = heap, *P = state + n;
    const E *A = Phi[mode], *C = A + y * all, *Q = noise[mode], *M_e = Q + all + m, *M_f = M_e + y * stride;
    const E* input = b.present() ? b[mode] : nullptr;
    Local<N> x(free, n);
    Local<triangle(N)> L(free, triangle(n));
    Deviations<N, M> by(free, n, m);
    each<N>(n, [&](int i) SALTUS_LAMBDA {
      x[i] = state[i];
      upto<N>(i, [&](int j) SALTUS_LAMBDA { L[packed(i, j)] = P[packed(i, j)]; });
    });
    factor<N>(n, L, free);
    each<N>(n, [&](int i) SALTUS_LAMBDA { by.weight[i] = L[packed(i, i)]; });
    each<M>(m, [&](int a) SALTUS_LAMBDA {
      V residual = input ? z[a] - input[y + a] : z[a];
      each<N>(n, [&](int k) SALTUS_LAMBDA { residual -= x[k] * C[a * all + k]; });
      if constexpr (!Inside) each<M>(m, [&](int c) SALTUS_LAMBDA { residual -= known[c] * C[a * all + y + c]; });
      by.nu[a] = residual * on[a];
      by.weight[n + a] = splat(1.0);
      each<M>(m, [&](int c) SALTUS_LAMBDA { by.y[a * wide + n + c] = splat(M_f[a * stride + c]); });
    });
    times_root<N, M>(n, m, C, all, L, &by.y[0], wide);
    times_root<N, N>(n, n, A, all, L, &by.x[0], wide);
    each<N>(n, [&](int i) SALTUS_LAMBDA {
      V moved = input ? splat(input[i]) : V{};
      each<N>(n, [&](int k) SALTUS_LAMBDA { moved += x[k] * A[i * all + k]; });
      if constexpr (!Inside) each<M>(m, [&](int c) SALTUS_LAMBDA { moved += known[c] * A[i * all + y + c]; });
      state[i] = moved;
      each<M>(m, [&](int a) SALTUS_LAMBDA { by.x[i * wide + n + a] = splat(M_e[i * stride + a]); });
    });
    bad |= conditioned<N, M, false>(n, m, by, on, state, report, Q, stride, free, true);
  }
  return bad;
}

// Squared Mahalanobis distance of the mixture's innovation: nu and S of every mode, weighted by the predicted `probs`.
template <int M>
V mixture_nis(const V* report, const V* probs, int size_m, int modes, V* heap) {
  const int m = M > 0 ? M : size_m;
  if (modes == 1) return report[0];  // one Gaussian is its own mixture
  const V* first = report + 2 + m;
  const int size = report_size(m);
  Local<M> mean(heap, m), gap(heap, m);
  Local<triangle(M)> S(heap, triangle(m));
  each<M>(m, [&](int a) SALTUS_LAMBDA {
    mean[a] = V{};
    upto<M>(a, [&](int b) SALTUS_LAMBDA { S[packed(a, b)] = V{}; });
  });
  for (int mode = 0; mode < modes; ++mode)
    each<M>(m, [&](int a) SALTUS_LAMBDA { mean[a] += probs[mode] * first[mode * size + a]; });
  for (int mode = 0; mode < modes; ++mode) {
    const V* nu = first + mode * size;
    const V weight = probs[mode];
    each<M>(m, [&](int a) SALTUS_LAMBDA { gap[a] = nu[a] - mean[a]; });
    each<M>(m, [&](int a) SALTUS_LAMBDA {
      const V scaled = weight * gap[a];
      upto<M>(a, [&](int b) SALTUS_LAMBDA { S[packed(a, b)] += weight * nu[m + packed(a, b)] + scaled * gap[b]; });
    });
  }
  V d2{};
  each<M>(m, [&](int a) SALTUS_LAMBDA { gap[a] = S[packed(a, a)] * (kRounding * m); });
  each<M>(m, [&](int a) SALTUS_LAMBDA {
    const V one_over = reciprocal(maximum(S[packed(a, a)], gap[a]));
    d2 += mean[a] * one_over * mean[a];
    from<M>(a + 1, m, [&](int b) SALTUS_LAMBDA {
      const V factor = S[packed(b, a)] * one_over;
      mean[b] -= factor * mean[a];
      from<M>(a + 1, m, [&](int c) SALTUS_LAMBDA {
        if (c <= b) S[packed(b, c)] -= factor * S[packed(c, a)];
      });
    });
  });
  return d2;
}

}  // namespace saltus::SALTUS_NS
