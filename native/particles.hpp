// Rao-Blackwellised particles: the rows of a bank without chains, each with a joint mode of its own beside it.
#pragma once

#include "bank.hpp"

namespace saltus::SALTUS_NS {

inline std::size_t expand_space(const Tracks& t, int modes, int m, Arena arena, V** copy, V** states, V** law,
                                V** report, V** value, V** on, V** heap) {
  *copy = arena.take(block_of(t));
  *states = arena.take(std::size_t(modes) * record_of(t));
  *law = arena.take(modes);
  *report = arena.take(std::size_t(modes) * report_size(m));
  *value = arena.take(m);
  *on = arena.take(m);
  *heap = arena.take(heap_size(t.n, m, 2) + modes);
  return arena.used;
}

// P(next mode | path, z) and log f(z | path) of every row, each a Gaussian whose present mode is mode[row]:
// every next mode is propagated and measured, the row itself stays as it is. Modes of one same[] share their dynamics.
inline Fault expand_rows(const Tracks& t, Rows rows, const Branches& to, int m, const double* z, const Model& F,
                       const Model& b, const Model& Q, const Model& H, const Model& d, const Model& R, double* law_out,
                       double* log_likelihood, Arena arena) {
  V *copy, *states, *law, *report, *value, *on, *heap;
  const int M = to.modes, record = record_of(t);
  arena.used = expand_space(t, M, m, arena, &copy, &states, &law, &report, &value, &on, &heap);
  int* index = arena.take_ints(M);
  for (int j = 0; j < M; ++j) index[j] = j;
  const Stages steps = stages(t.n, m);
  Fault fault{};
  for (Size first = 0; first < rows.count; first += W) {
    const Group group(t, rows, first, copy);
    const double* from[W];
    for (int l = 0; l < W; ++l) from[l] = to.trans + to.now[first + (l < group.lanes ? l : group.lanes - 1)] * M;
    load_lanes(from, M, law);
    for (int j = 0; j < M; ++j) {
      const V* source = to.same[j] == j ? group.belief + 1 : states + Size(to.same[j]) * record;
      V* state = states + Size(j) * record;
      for (int i = 0; i < record; ++i) state[i] = source[i];
      if (to.same[j] == j)
        steps.shared.propagate(state, t.n, 1, {F.data, F.which + j, F.core}, {b.data, b.data ? b.which + j : nullptr, b.core},
                               {Q.data, Q.which + j, Q.core}, heap);
    }
    load_model(Model{z, nullptr, m, 0, 1, m, nullptr}, first, rows.count, 0, value);
    V seen{};
    for (int a = 0; a < m; ++a) {
      on[a] = select(value[a] == value[a], splat(1.0), V{});
      value[a] = select(value[a] == value[a], value[a], V{});
      seen += on[a];
    }
    const I bad = steps.shared.update(states, t.n, m, M, {H.data, H.which, H.core}, {d.data, d.which, d.core},
                                     {R.data, R.which, R.core}, value, on, report, heap, false);
    if (any(bad)) note(fault, bad, report, M, m, first, group.lanes);
    bool logs = false;
    const V likelihood = reweigh(law, logs, M, m, report, seen, heap);
    const I lost = lost_lanes(likelihood, false);
    if (any(lost)) note(fault, lost, report, M, m, first, group.lanes);
    if (logs)
      for (int j = 0; j < M; ++j) law[j] = exponential(law[j]);
    store_lanes(law, index, M, law_out + first * M, M, group.lanes);
    for (int l = 0; l < group.lanes; ++l) log_likelihood[first + l] = likelihood[l];
  }
  return fault;
}

// Sums over the rows of each label of width numbers per row, taken by `value(state, i)` from a row's lane-strided state.
// Rows of a whole block with one label, as sorted particles mostly are, are added up lane by lane.
template <class Lanes>
inline void sum_by_label(const Tracks& t, Rows rows, const double* weight, const std::int64_t* label, int width,
                         double* out, V* sums, Lanes add) {
  const Size size = block_of(t);
  const std::int64_t none = -1;
  std::int64_t current = none;
  const auto flush = [&] {
    if (current == none) return;
    for (int i = 0; i < width; ++i)
      for (int l = 0; l < W; ++l) out[current * width + i] += sums[i][l];
    current = none;
  };
  for (Size first = 0; first < rows.count; first += W) {
    const int lanes = int(rows.count - first < W ? rows.count - first : W);
    bool whole = lanes == W && rows.index[first] % W == 0;
    for (int l = 1; l < lanes; ++l)
      whole = whole && rows.index[first + l] == rows.index[first] + l && label[first + l] == label[first];
    for (int l = 0; l < (whole ? 1 : lanes); ++l) {
      const std::int64_t row = rows.index[first + l], to = label[first + l];
      if (to != current) {
        flush();
        current = to;
        for (int i = 0; i < width; ++i) sums[i] = V{};
      }
      V w{};
      if (whole)
        w = load(weight + first);
      else
        w[row % W] = weight[first + l];  // the other lanes of its block count nothing
      add(reinterpret_cast<const V*>(t.data + (row / W) * size * W) + 1, w, to, sums);
    }
  }
  flush();
}

// Weighted mean and covariance of the rows of each label, the spread of their means included. Two passes: the spread is
// a sum of squares about the label's own mean.
inline void merge_rows(const Tracks& t, Rows rows, const double* weight, const std::int64_t* label, Size labels,
                       double* mass, double* means, double* covs, double* totals, Arena arena) {
  const int n = t.n, tri = triangle(n);
  V *sums = arena.take(1 + record_of(t)), *gap = arena.take(n);
  for (Size i = 0; i < labels * (1 + n); ++i) totals[i] = 0.0;
  sum_by_label(t, rows, weight, label, 1 + n, totals, sums, [&](const V* x, V w, std::int64_t, V* s) {
    s[0] += w;
    for (int i = 0; i < n; ++i) s[1 + i] += w * select(w != 0.0, x[i], V{});
  });
  for (Size k = 0; k < labels; ++k) {
    mass[k] = totals[k * (1 + n)];
    for (int i = 0; i < n; ++i) means[k * n + i] = mass[k] > 0.0 ? totals[k * (1 + n) + 1 + i] / mass[k] : 0.0;
  }
  for (Size i = 0; i < labels * tri; ++i) totals[i] = 0.0;
  sum_by_label(t, rows, weight, label, tri, totals, sums, [&](const V* x, V w, std::int64_t to, V* s) {
    for (int i = 0; i < n; ++i) gap[i] = select(w != 0.0, x[i] - means[to * n + i], V{});
    for (int i = 0; i < n; ++i)
      for (int j = 0; j <= i; ++j)
        s[packed(i, j)] += w * (select(w != 0.0, x[n + packed(i, j)], V{}) + gap[i] * gap[j]);
  });
  for (Size k = 0; k < labels; ++k)
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j)
        covs[(k * n + i) * n + j] = mass[k] > 0.0 ? totals[k * tri + packed(i, j)] / mass[k] : 0.0;
}

}  // namespace saltus::SALTUS_NS
