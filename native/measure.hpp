// What a measurement says of every mode and does to it: twins of measure, joint, condition and mixture_nis in
// src/saltus/filters/steps.py.
#pragma once

#include "step.hpp"

namespace saltus::SALTUS_NS {

// Per mode in `report`: [d2 | 1 / det S | pivots (m) | nu (m) | S packed].
SALTUS_INLINE constexpr int report_size(int m) { return 2 + 2 * m + triangle(m); }

// S = L D L' in place of S: `inverse` becomes D^-1, 0 where not seen, and nu becomes L^-1 nu. Says d2, 1 / det S and
// the pivots in `report`; returns the lanes in which S was not positive definite.
template <int M>
SALTUS_INLINE I factor(int m, Local<triangle(M)>& L, Local<M>& nu, Local<M>& inverse, const V* on, V* report) {
  V d2{}, inverse_det = splat(1.0);
  I bad{};
  each<M>(m, [&](int a) SALTUS_LAMBDA {
    const V pivot = L[packed(a, a)];
    bad |= ~(pivot > 0.0);
    report[2 + a] = pivot;
    const V one_over = reciprocal(pivot);
    inverse_det *= one_over;
    inverse[a] = one_over * on[a];
    from<M>(a + 1, m, [&](int b) SALTUS_LAMBDA {
      const V factor = L[packed(b, a)] * one_over;
      nu[b] -= factor * nu[a];
      from<M>(a + 1, m, [&](int c) SALTUS_LAMBDA {
        if (c <= b) L[packed(b, c)] -= factor * L[packed(c, a)];
      });
    });
    from<M>(a + 1, m, [&](int b) SALTUS_LAMBDA { L[packed(b, a)] *= one_over; });
    d2 += nu[a] * nu[a] * inverse[a];
  });
  report[0] = d2;
  report[1] = inverse_det;
  return bad;
}

// K = U S^-1 and x += K nu, of what `factor` left. `w` is scratch.
template <int N, int M>
SALTUS_INLINE void gain(int n, int m, Local<N * M>& U, Local<triangle(M)>& L, Local<M>& inverse, Local<M>& nu,
                        Local<M>& w, V* x, Local<N * M>& K) {
  each<N>(n, [&](int i) SALTUS_LAMBDA {
    each<M>(m, [&](int a) SALTUS_LAMBDA {
      V g = U[i * m + a];
      upto<M>(a - 1, [&](int b) SALTUS_LAMBDA { g -= L[packed(a, b)] * w[b]; });
      w[a] = g;
    });
    V moved = x[i];
    each<M>(m, [&](int a) SALTUS_LAMBDA {
      w[a] *= inverse[a];
      moved += w[a] * nu[a];
    });
    x[i] = moved;
    each<M>(m, [&](int back) SALTUS_LAMBDA {
      const int a = m - 1 - back;
      V g = w[a];
      from<M>(a + 1, m, [&](int b) SALTUS_LAMBDA { g -= L[packed(b, a)] * K[i * m + b]; });
      K[i * m + a] = g;
    });
  });
}

// Measure and condition every mode (`Gain`), or measure only, in Joseph form.
//
//   nu = z - H x - d,  U = P H',  S = H U + R = L D L',  K = U S^-1,  T = P - K U' = (I - K H) P,
//   P+ = T (I - K H)' + K R K' = T - (T H' - K R) K'.
//
// The last form costs n^2 m where the product with I - K H costs n^3, and keeps what makes Joseph's form safe: an
// error in T is multiplied by (I - K H)', which annihilates it in the measured directions. A component not seen
// (on = 0) has its row of nu, of L and of D^-1 zero, hence its column of K: no branch. Returns the lanes in which an S
// was not positive definite.
template <int N, int M, class E, bool Gain>
I measure(V* state, int size_n, int size_m, int modes, ByMode<E> H, ByMode<E> d, ByMode<E> R, const V* z, const V* on,
          V* report, V* heap) {
  const int n = N > 0 ? N : size_n, m = M > 0 ? M : size_m;
  const int record = n + triangle(n);
  I bad{};
  for (int mode = 0; mode < modes; ++mode, state += record, report += report_size(m)) {
    V* free = heap;
    const E *h = H[mode], *r = R[mode];
    V *x = state, *P = state + n;
    Local<N * M> U(free, n * m);
    Local<triangle(M)> L(free, triangle(m));
    Local<M> nu(free, m), inverse(free, m);
    each<N>(n, [&](int i) SALTUS_LAMBDA {
      each<M>(m, [&](int a) SALTUS_LAMBDA {
        V sum = P[packed(i, 0)] * h[a * n];
        from<N>(1, n, [&](int k) SALTUS_LAMBDA { sum += P[packed(i, k)] * h[a * n + k]; });
        U[i * m + a] = sum;
      });
    });
    V* S = report + 2 + 2 * m;
    each<M>(m, [&](int a) SALTUS_LAMBDA {
      V residual = z[a];
      if (d.present()) residual -= d[mode][a];
      each<N>(n, [&](int k) SALTUS_LAMBDA { residual -= x[k] * h[a * n + k]; });
      nu[a] = residual * on[a];
      report[2 + m + a] = nu[a];
      upto<M>(a, [&](int b) SALTUS_LAMBDA {
        V sum = splat(r[a * m + b]);
        each<N>(n, [&](int k) SALTUS_LAMBDA { sum += U[k * m + b] * h[a * n + k]; });
        sum = a == b ? select(on[a] != 0.0, sum, splat(1.0)) : sum * (on[a] * on[b]);
        L[packed(a, b)] = sum;
        S[packed(a, b)] = sum;
      });
    });
    bad |= factor<M>(m, L, nu, inverse, on, report);
    if constexpr (Gain) {
      Local<N * M> K(free, n * m);
      Local<N> T(free, n);
      Local<M> w(free, m);
      gain<N, M>(n, m, U, L, inverse, nu, w, x, K);
      // In place: row i writes P[i][j <= i] only, which no later row reads.
      each<N>(n, [&](int i) SALTUS_LAMBDA {
        each<N>(n, [&](int j) SALTUS_LAMBDA {
          V t = P[packed(i, j)];
          each<M>(m, [&](int a) SALTUS_LAMBDA { t -= K[i * m + a] * U[j * m + a]; });
          T[j] = t;
        });
        each<M>(m, [&](int a) SALTUS_LAMBDA {
          V g = T[0] * h[a * n];
          from<N>(1, n, [&](int k) SALTUS_LAMBDA { g += T[k] * h[a * n + k]; });
          each<M>(m, [&](int b) SALTUS_LAMBDA { g -= K[i * m + b] * r[a * m + b]; });
          w[a] = g;
        });
        upto<N>(i, [&](int j) SALTUS_LAMBDA {
          V t = T[j];
          each<M>(m, [&](int a) SALTUS_LAMBDA { t -= w[a] * K[j * m + a]; });
          P[packed(i, j)] = t;
        });
      });
    }
  }
  return bad;
}

// Move and condition every mode at once, where what is measured is the part y of s = (x, y), without noise of its own.
// `Inside`, y is in the state, which is s: Phi = A, C is its last m rows, and `known` is not read. Otherwise y was
// `known` before the interval and only x is in the state: Phi = [A D; C E], with known inputs D y and E y. The noises
// e of s and f of y are e = M u + v, f = M_f u, cov u = I, cov v = Q: `noise` is [Q | cov(e, f) | M] by rows of s.
//
//   x~ = A x + b,  nu = z - C x - d,  V = P C',  U = A V + N_ef,  S = C V + N_ff = L D L',  K = U S^-1,  G = A - K C,
//   P+ = G P G' + [I -K] N [I -K]' = G P G' + (M - K M_f) (M - K M_f)' + Q.
//
// The last form is a sum of squares: what the measurement tells exactly is left with a variance of 0, not of rounding.
template <int N, int M, class E, bool Inside>
I advance(V* state, int size_n, int size_m, int modes, ByMode<E> Phi, ByMode<E> b, ByMode<E> noise, const V* known, const V* z, const V* on, V* report, V* heap) {
  if constexpr (Inside && N > 0 && N <= M) return I{};  // there is no such state
  const int n = N > 0 ? N : size_n, m = M > 0 ? M : size_m;
  const int all = Inside ? n : n + m, y = all - m;  // the size of s, and where y begins in it
  const int wide = all + 2 * m;
  const int record = n + triangle(n);
  I bad{};
  for (int mode = 0; mode < modes; ++mode, state += record, report += report_size(m)) {
    V* free = heap;
    const E *A = Phi[mode], *C = A + y * all;
    const E *Q = noise[mode], *N_e = Q + all, *M_e = N_e + m, *N_f = N_e + y * wide, *M_f = M_e + y * wide;
    const E* input = b.present() ? b[mode] : nullptr;
    Local<N> x(free, n);
    Local<triangle(N)> P(free, triangle(n));
    Local<N * M> W(free, n * m), U(free, n * m);
    Local<triangle(M)> L(free, triangle(m));
    Local<M> nu(free, m), inverse(free, m), w(free, m);
    each<N>(n, [&](int i) SALTUS_LAMBDA {
      x[i] = state[i];
      upto<N>(i, [&](int j) SALTUS_LAMBDA { P[packed(i, j)] = state[n + packed(i, j)]; });
    });
    each<N>(n, [&](int i) SALTUS_LAMBDA {
      each<M>(m, [&](int a) SALTUS_LAMBDA {
        V sum = P[packed(i, 0)] * C[a * all];
        from<N>(1, n, [&](int k) SALTUS_LAMBDA { sum += P[packed(i, k)] * C[a * all + k]; });
        W[i * m + a] = sum;
      });
    });
    V* S = report + 2 + 2 * m;
    each<M>(m, [&](int a) SALTUS_LAMBDA {
      V residual = input ? z[a] - input[y + a] : z[a];
      each<N>(n, [&](int k) SALTUS_LAMBDA { residual -= x[k] * C[a * all + k]; });
      if constexpr (Inside)
        residual *= on[a];
      else
        each<M>(m, [&](int c) SALTUS_LAMBDA { residual -= known[c] * C[a * all + y + c]; });
      nu[a] = residual;
      report[2 + m + a] = residual;
      upto<M>(a, [&](int c) SALTUS_LAMBDA {
        V sum = splat(N_f[a * wide + c]);
        each<N>(n, [&](int k) SALTUS_LAMBDA { sum += W[k * m + c] * C[a * all + k]; });
        if constexpr (Inside) sum = a == c ? select(on[a] != 0.0, sum, splat(1.0)) : sum * (on[a] * on[c]);
        L[packed(a, c)] = sum;
        S[packed(a, c)] = sum;
      });
    });
    bad |= factor<M>(m, L, nu, inverse, on, report);
    each<N>(n, [&](int i) SALTUS_LAMBDA {
      V moved = input ? splat(input[i]) : V{};
      each<N>(n, [&](int k) SALTUS_LAMBDA { moved += x[k] * A[i * all + k]; });
      if constexpr (!Inside) each<M>(m, [&](int c) SALTUS_LAMBDA { moved += known[c] * A[i * all + y + c]; });
      state[i] = moved;
      each<M>(m, [&](int a) SALTUS_LAMBDA {
        V sum = splat(N_e[i * wide + a]);
        each<N>(n, [&](int k) SALTUS_LAMBDA { sum += W[k * m + a] * A[i * all + k]; });
        U[i * m + a] = sum;
      });
    });
    Local<N * M>& K = W;
    gain<N, M>(n, m, U, L, inverse, nu, w, state, K);
    Local<N * N> G(free, n * n);
    Local<N> T(free, n);
    Local<N * M>& D = U;
    each<N>(n, [&](int i) SALTUS_LAMBDA {
      each<N>(n, [&](int k) SALTUS_LAMBDA {
        V g = splat(A[i * all + k]);
        each<M>(m, [&](int a) SALTUS_LAMBDA { g -= K[i * m + a] * C[a * all + k]; });
        G[i * n + k] = g;
      });
      each<M>(m, [&](int a) SALTUS_LAMBDA {
        V g = splat(M_e[i * wide + a]);
        each<M>(m, [&](int c) SALTUS_LAMBDA { g -= K[i * m + c] * M_f[c * wide + a]; });
        D[i * m + a] = g;
      });
    });
    each<N>(n, [&](int i) SALTUS_LAMBDA {
      each<N>(n, [&](int c) SALTUS_LAMBDA {
        V t = G[i * n] * P[packed(0, c)];
        from<N>(1, n, [&](int k) SALTUS_LAMBDA { t += G[i * n + k] * P[packed(k, c)]; });
        T[c] = t;
      });
      upto<N>(i, [&](int j) SALTUS_LAMBDA {
        V sum = splat(Q[i * wide + j]);
        each<M>(m, [&](int a) SALTUS_LAMBDA { sum += D[i * m + a] * D[j * m + a]; });
        each<N>(n, [&](int c) SALTUS_LAMBDA { sum += T[c] * G[j * n + c]; });
        state[n + packed(i, j)] = sum;
      });
    });
  }
  return bad;
}

// Squared Mahalanobis distance of the mixture's innovation: nu and S of every mode, weighted by the predicted `probs`.
template <int M>
V mixture_nis(const V* report, const V* probs, int size_m, int modes, V* heap) {
  const int m = M > 0 ? M : size_m;
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
  each<M>(m, [&](int a) SALTUS_LAMBDA {
    const V one_over = reciprocal(S[packed(a, a)]);
    d2 += mean[a] * mean[a] * one_over;
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
