// Steps on rows of a bank, W rows at a time: in place where they are the lanes of one block, through a copy elsewhere.
#pragma once

#include "law.hpp"
#include "rows.hpp"
#include "stages.hpp"

namespace saltus::SALTUS_NS {

inline int record_of(const Tracks& t) { return t.n + triangle(t.n); }
inline std::size_t block_of(const Tracks& t) { return std::size_t(t.modes) * (1 + record_of(t)); }

// W addressed rows with their beliefs in lanes; the last row fills the lanes beyond it.
class Group {
 public:
  Group(const Tracks& tracks, Rows rows, Size first, V* copy)
      : tracks_(tracks), rows_(rows.index + first), size(block_of(tracks)) {
    lanes = int(rows.count - first < W ? rows.count - first : W);
    in_place_ = lanes == W && rows_[0] % W == 0;
    for (int l = 1; l < lanes; ++l) in_place_ = in_place_ && rows_[l] == rows_[0] + l;
    belief = in_place_ ? reinterpret_cast<V*>(element(rows_[0])) : copy;
    if (!in_place_)
      for (int l = 0; l < W; ++l) {
        const double* source = element(rows_[l < lanes ? l : lanes - 1]);
        for (std::size_t i = 0; i < size; ++i) belief[i][l] = source[i * W];
      }
  }

  void write_back() const {
    if (in_place_) return;
    for (int l = 0; l < lanes; ++l) {
      double* target = element(rows_[l]);
      for (std::size_t i = 0; i < size; ++i) target[i * W] = belief[i][l];
    }
  }

  double* element(std::int64_t row) const { return tracks_.data + (row / W) * Size(size) * W + row % W; }

  V* belief;  // [log P(modes) | records]
  int lanes;

 private:
  const Tracks& tracks_;
  const std::int64_t* rows_;
  std::size_t size;
  bool in_place_;
};

inline std::size_t bank_space(const Tracks& t, int m, Arena arena, V** copy, V** law, V** heap) {
  int largest = 2;
  for (int c = 0; c < t.chains; ++c) largest = t.sizes[c] > largest ? t.sizes[c] : largest;
  *copy = arena.take(block_of(t));
  *law = arena.take(2 * t.modes);
  *heap = arena.take(heap_size(t.n, m, largest) + t.modes);
  return arena.used;
}

inline ByMode<V> staged(const Model& model, Size first, Size count, V*& free) {
  V* data = free;
  load_model(model, first, count, 0, data);
  free += lanes_of(model);
  return {model.data ? data : nullptr, model.which, model.core};
}

inline int step_rows(const Tracks& t, Rows rows, const Model* trans, const Model& F, const Model& b, const Model& Q,
                      Arena arena) {
  V *copy, *law, *heap;
  V* models = arena.base + bank_space(t, 1, arena, &copy, &law, &heap);
  const Stages steps = stages(t.n, 1);
  bool bad = doubtful_rows(F, rows.count, 0, models, heap) || doubtful_rows(b, rows.count, 0, models, heap);
  for (int c = 0; c < t.chains; ++c) bad = bad || doubtful_rows(trans[c], rows.count, 0, models, heap);
  if (bad || doubtful_rows(Q, rows.count, t.n, models, heap)) return kDoubtful;
  for (Size first = 0; first < rows.count; first += W) {
    const Group group(t, rows, first, copy);
    V* state = group.belief + t.modes;
    for (int j = 0; j < t.modes; ++j) law[j] = group.belief[j];
    bool logs = still_in_logs(law, t.modes);
    for (int c = 0, outer = 1, inner = t.modes; c < t.chains; outer *= t.sizes[c], ++c) {
      inner /= t.sizes[c];
      if (!trans[c].data) continue;
      load_model(trans[c], first, rows.count, 0, models);
      steps.lanes.mix(state, law, t.n, outer, t.sizes[c], inner, models, logs, heap);
    }
    V* free = models;
    const ByMode<V> f = staged(F, first, rows.count, free), u = staged(b, first, rows.count, free);
    steps.lanes.propagate(state, t.n, t.modes, f, u, staged(Q, first, rows.count, free), heap);
    if (!logs) into_logs(law, t.modes);
    for (int j = 0; j < t.modes; ++j) group.belief[j] = law[j];
    group.write_back();
  }
  return kFine;
}

// Keep the first fault of the lanes given up of a group that begins with row `first`.
inline void note(Fault& fault, I lanes, const V* report, int modes, int m, Size first, int count) {
  for (int l = 0; l < count && fault.kind == kFine; ++l)
    if (lanes[l]) {
      fault = fault_of(report, modes, m, l);
      fault.row = first + l;
    }
}

inline Fault measure_rows(const Tracks& t, Rows rows, bool write, int m, const double* z, const Model& H, const Model& d,
                        const Model& R, double* d2, double* log_likelihood, Arena arena) {
  V *copy, *law, *heap;
  arena.used = bank_space(t, m, arena, &copy, &law, &heap);
  V *report = arena.take(std::size_t(t.modes) * report_size(m)), *value = arena.take(m), *on = arena.take(m);
  V* models = arena.base + arena.used;
  const Stages steps = stages(t.n, m);
  if (doubtful_rows(H, rows.count, 0, models, heap) || doubtful_rows(d, rows.count, 0, models, heap) ||
      doubtful_rows(R, rows.count, m, models, heap))
    return {kDoubtful, 0, 0};
  Fault fault{};
  for (Size first = 0; first < rows.count; first += W) {
    const Group group(t, rows, first, copy);
    const Model measured{z, nullptr, m, 0, 1, m, nullptr};
    load_model(measured, first, rows.count, 0, value);
    V seen{};
    for (int a = 0; a < m; ++a) {
      on[a] = select(value[a] == value[a], splat(1.0), V{});
      value[a] = select(value[a] == value[a], value[a], V{});
      seen += on[a];
    }
    V* free = models;
    const ByMode<V> h = staged(H, first, rows.count, free), o = staged(d, first, rows.count, free);
    const ByMode<V> r = staged(R, first, rows.count, free);
    const I bad =
        steps.lanes.update(group.belief + t.modes, t.n, m, t.modes, h, o, r, value, on, report, heap, write);
    if (any(bad)) note(fault, bad, report, t.modes, m, first, group.lanes);
    if (t.modes == 1) {  // one Gaussian has no law to reweigh, and is its own mixture
      V log_det{};
      for (int a = 0; a < m; ++a) log_det += logarithm(report[2 + a]);
      const V likelihood = -0.5 * (report[0] + log_det + seen * kLog2Pi);
      const I lost = lost_lanes(likelihood, write);
      if (any(lost)) note(fault, lost, report, 1, m, first, group.lanes);
      for (int l = 0; l < group.lanes; ++l) d2[first + l] = report[0][l], log_likelihood[first + l] = likelihood[l];
      if (write) group.write_back();
      continue;
    }
    for (int j = 0; j < t.modes; ++j) law[j] = group.belief[j];
    bool logs = still_in_logs(law, t.modes);
    probabilities(law, logs, t.modes, law + t.modes);
    const V distance = steps.nis(report, law + t.modes, m, t.modes, heap);
    const V likelihood = reweigh(law, logs, t.modes, m, report, seen, heap);
    const I lost = lost_lanes(likelihood, write);
    if (any(lost)) note(fault, lost, report, t.modes, m, first, group.lanes);
    for (int l = 0; l < group.lanes; ++l) d2[first + l] = distance[l], log_likelihood[first + l] = likelihood[l];
    if (!write) continue;
    if (!logs) into_logs(law, t.modes);
    for (int j = 0; j < t.modes; ++j) group.belief[j] = law[j];
    group.write_back();
  }
  return fault;
}

inline void moments_of_rows(const Tracks& t, Rows rows, double* mean, double* cov, double* probs, Arena arena) {
  V *copy, *law, *heap;
  arena.used = bank_space(t, 1, arena, &copy, &law, &heap);
  const int n = t.n, record = record_of(t);
  V* out = arena.take(record + t.modes);
  int* index = arena.take_ints(n * n + record + t.modes);
  symmetric_index(n, n, index);
  for (int i = 0; i < record + t.modes; ++i) index[n * n + i] = i;
  const Stages steps = stages(n, 1);
  for (Size first = 0; first < rows.count; first += W) {
    const Group group(t, rows, first, copy);
    probabilities(group.belief, true, t.modes, out + record);
    steps.collapse(group.belief + t.modes, out + record, n, t.modes, out, heap);
    store_lanes(out, index, n * n, cov + first * n * n, n * n, group.lanes);
    store_lanes(out, index + n * n, n, mean + first * n, n, group.lanes);
    store_lanes(out, index + n * n + record, t.modes, probs + first * t.modes, t.modes, group.lanes);
  }
}

inline void read_rows(const Tracks& t, Rows rows, double* log_probs, double* means, double* covs, Arena arena) {
  V* copy = arena.take(block_of(t));
  const int n = t.n, record = record_of(t);
  for (Size first = 0; first < rows.count; first += W) {
    const Group group(t, rows, first, copy);
    for (int l = 0; l < group.lanes; ++l)
      for (int j = 0; j < t.modes; ++j) {
        const Size at = (first + l) * t.modes + j;
        const V* state = group.belief + t.modes + Size(j) * record;
        log_probs[at] = group.belief[j][l];
        for (int i = 0; i < n; ++i) means[at * n + i] = state[i][l];
        for (int i = 0; i < n * n; ++i) covs[at * n * n + i] = state[n + packed(i / n, i % n)][l];
      }
  }
}

inline void write_rows(const Tracks& t, Rows rows, const double* log_probs, const double* means, const double* covs) {
  const int n = t.n, record = record_of(t);
  const Size size = block_of(t);
  for (Size r = 0; r < rows.count; ++r) {
    double* target = t.data + (rows.index[r] / W) * size * W + rows.index[r] % W;
    for (int j = 0; j < t.modes; ++j) {
      const Size at = r * t.modes + j;
      double* state = target + (t.modes + Size(j) * record) * W;
      target[j * W] = log_probs[at];
      for (int i = 0; i < n; ++i) state[i * W] = means[at * n + i];
      for (int i = 0; i < n; ++i)
        for (int k = 0; k <= i; ++k) {
          const double *P = covs + at * n * n;
          state[(n + packed(i, k)) * W] = 0.5 * (P[i * n + k] + P[k * n + i]);
        }
    }
  }
}

// The mixture of each group of copies, mode by mode: weights first, then means, then spreads about them. Groups differ in
// size and their copies lie in any lane, so elements are taken one at a time.
inline void merge_copies(const Tracks& from, const std::int64_t* start, const double* log_weight, const Tracks& to,
                         Rows target, Arena arena) {
  const int n = from.n, record = record_of(from);
  const Size size = block_of(from);
  double* share = reinterpret_cast<double*>(arena.base);  // W shares at a time, then the merged record
  double* merged = share + W;
  const auto element = [&](const Tracks& t, Size row, Size i) -> double& {
    return t.data[((row / W) * size + i) * W + row % W];
  };
  for (Size g = 0; g < target.count; ++g) {
    const Size first = start[g], stop = start[g + 1];
    for (int j = 0; j < from.modes; ++j) {
      const Size state = from.modes + Size(j) * record;
      const auto joint = [&](Size c) { return log_weight[c] + element(from, c, j); };
      double top = -__builtin_inf();
      for (Size c = first; c < stop; ++c) top = joint(c) > top ? joint(c) : top;
      if (!(top > -__builtin_inf())) top = 0.0;
      double sum = 0.0, total = 0.0;
      for (int i = 0; i < record; ++i) merged[i] = 0.0;
      // Twice over the copies, W weights at a time: sums of means, then of spreads about the merged mean.
      for (int pass = 0; pass < 2; ++pass) {
        for (Size c0 = first; c0 < stop; c0 += W) {
          const int some = int(stop - c0 < W ? stop - c0 : W);
          V logs = splat(-__builtin_inf());
          for (int l = 0; l < some; ++l) logs[l] = joint(c0 + l) - top;
          store(share, exponential(logs));
          for (int l = 0; l < some; ++l) {
            const double w = share[l] + kFloor;
            if (pass == 0) {
              sum += share[l], total += w;
              for (int i = 0; i < n; ++i) merged[i] += w * element(from, c0 + l, state + i);
              continue;
            }
            for (int i = 0; i < n; ++i) {
              const double part = w / total, away = element(from, c0 + l, state + i) - merged[i];
              for (int k = 0; k <= i; ++k) {
                const int at = n + packed(i, k);
                merged[at] += part * element(from, c0 + l, state + at) +
                              part * away * (element(from, c0 + l, state + k) - merged[k]);  // no square overflows
              }
            }
          }
        }
        if (pass == 0)
          for (int i = 0; i < n; ++i) merged[i] /= total;
      }
      element(to, target.index[g], j) = logarithm(splat(sum))[0] + top;
      for (int i = 0; i < record; ++i) element(to, target.index[g], state + i) = merged[i];
    }
  }
}

inline void copy_rows(const Tracks& from, Rows source, const Tracks& to, Rows target) {
  const Size size = block_of(from);
  for (Size r = 0; r < source.count; ++r) {
    const double* in = from.data + (source.index[r] / W) * size * W + source.index[r] % W;
    double* out = to.data + (target.index[r] / W) * size * W + target.index[r] % W;
    for (Size i = 0; i < size; ++i) out[i * W] = in[i * W];
  }
}

}  // namespace saltus::SALTUS_NS
