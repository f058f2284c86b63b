// The recursion along time for one block of tracks after another: mix, propagate, measure, condition, reweigh, store.
#pragma once

#include "law.hpp"
#include "rows.hpp"
#include "stages.hpp"

namespace saltus::SALTUS_NS {

// One output array: `width` doubles per row of a track, gathered from the step's slot of the buffer.
struct Field {
  double* out;
  int width;
  int* index;  // for all slots of the buffer, so that whole runs of rows are stored at once
};

class Recursion {
 public:
  Recursion(const Problem& problem, Arena arena)
      : p(problem),
        n(problem.n),
        m(problem.m),
        record(n + triangle(n)),
        steps(stages(n, m)),
        dynamics_by_lane(p.F.row || p.b.row || p.Q.row),
        sensor_by_lane(p.H.row || p.d.row || p.R.row) {
    divide(arena);
    used_ = arena.used;
    if (arena.base) plan_output();
  }

  std::size_t used() const { return used_; }

  int run(Size first_block, Size last_block) {
    for (Size block = first_block; block < last_block; ++block) {
      first = block * W;
      tracks = p.n_tracks - first < W ? int(p.n_tracks - first) : W;
      load_prior();
      for (Size k = 0; k < p.n_steps; ++k) {
        const int slot = int(k % W);
        if (slot == 0) load_measurements(k);
        predict(k);
        const bool keep = p.every || k == p.n_steps - 1;
        V* out = buffer + slot * slot_size;
        update(k, slot, keep, out);
        if (keep) output(out);
        store_steps(k, slot);
      }
    }
    return status;
  }

 private:
  static constexpr int kFields = 6, kLikelihood = 5;  // mean, cov, probs, nis, n_observed, log_likelihood

  void divide(Arena& arena) {
    int largest = 2;
    for (int c = 0; c < p.chains; ++c) largest = p.sizes[c] > largest ? p.sizes[c] : largest;
    heap = arena.take(heap_size(n, m, largest) + p.modes);
    state = arena.take(std::size_t(p.modes) * record);
    law = arena.take(p.modes);
    probs = arena.take(p.modes);
    report = arena.take(std::size_t(p.modes) * report_size(m));
    z_raw = arena.take(W * m);
    z = arena.take(m);
    on = arena.take(m);
    F = arena.take(lanes_of(p.F)), b = arena.take(lanes_of(p.b)), Q = arena.take(lanes_of(p.Q));
    H = arena.take(lanes_of(p.H)), d = arena.take(lanes_of(p.d)), R = arena.take(lanes_of(p.R));
    prior = arena.take(lanes_of(p.mean0) + lanes_of(p.cov0));
    std::size_t largest_trans = 0;
    for (int c = 0; c < p.chains; ++c)
      if (lanes_of(p.trans[c]) > largest_trans) largest_trans = lanes_of(p.trans[c]);
    trans = arena.take(largest_trans);
    slot_size = record + p.modes + 3;
    buffer = arena.take(std::size_t(W) * slot_size);
    const int widths[kFields] = {n, n * n, p.modes, 1, 1, 1};
    for (int f = 0; f < kFields; ++f) fields[f] = {nullptr, widths[f], arena.take_ints(std::size_t(W) * widths[f])};
    if (p.mode_means) {
      by_mode_fields[0] = {p.mode_means, p.modes * n, arena.take_ints(std::size_t(p.modes) * n)};
      by_mode_fields[1] = {p.mode_covs, p.modes * n * n, arena.take_ints(std::size_t(p.modes) * n * n)};
    }
  }

  void plan_output() {
    double* const out[kFields] = {p.mean, p.cov, p.probs, p.nis, p.n_observed, p.log_likelihood};
    for (int slot = 0; slot < W; ++slot) {
      const int at = slot * slot_size;
      const int offset[kFields] = {at, at + n, at + record, at + record + p.modes, at + record + p.modes + 1,
                      at + record + p.modes + 2};
      for (int f = 0; f < kFields; ++f) {
        Field& field = fields[f];
        field.out = out[f];
        int* index = field.index + slot * field.width;
        if (f == 1)
          symmetric_index(n, offset[f], index);
        else
          for (int i = 0; i < field.width; ++i) index[i] = offset[f] + i;
      }
    }
    if (!p.mode_means) return;
    for (int mode = 0; mode < p.modes; ++mode) {
      for (int i = 0; i < n; ++i) by_mode_fields[0].index[mode * n + i] = mode * record + i;
      symmetric_index(n, mode * record + n, by_mode_fields[1].index + mode * n * n);
    }
  }

  void load_prior() {
    V *mean = prior, *cov = prior + lanes_of(p.mean0);
    load_model(p.mean0, first, p.n_tracks, 0, mean);
    load_model(p.cov0, first, p.n_tracks, 0, cov);
    load_model(p.log_probs0, first, p.n_tracks, 0, law);
    for (int mode = 0; mode < p.modes; ++mode) {
      V* x = state + mode * record;
      for (int i = 0; i < n; ++i) {
        x[i] = mean[p.mean0.which[mode] * n + i];
        for (int j = 0; j <= i; ++j) x[n + packed(i, j)] = cov[p.cov0.which[mode] * n * n + i * n + j];
      }
    }
    logs = true;
  }

  void load_measurements(Size k) {
    const double* rows[W];
    for (int l = 0; l < W; ++l) rows[l] = p.z + ((first + (l < tracks ? l : tracks - 1)) * p.n_steps + k) * m;
    const int count = int(p.n_steps - k < W ? p.n_steps - k : W) * m;
    load_lanes(rows, count, z_raw);
    I infinite{};
    for (int i = 0; i < count; ++i) infinite |= (z_raw[i] == __builtin_inf()) | (z_raw[i] == -__builtin_inf());
    if (any(infinite)) status |= kInfinite;
  }

  template <class E>
  static ByMode<E> by_mode(const Model& model, const E* data) {
    return {model.data ? data : nullptr, model.which, model.core};
  }

  static ByMode<double> shared(const Model& model, Size k) { return by_mode(model, address(model, 0, k)); }

  // `order` is that of a covariance, 0 for any other array.
  ByMode<V> by_lane(const Model& model, Size k, V* staged, int order) {
    if (k == 0 || model.time) {
      load_model(model, first, p.n_tracks, k, staged);
      if (model.row && any(doubtful(model, staged, order))) status |= kDoubtful;
    }
    return by_mode<V>(model, staged);
  }

  void predict(Size k) {
    int outer = 1, inner = p.modes;
    for (int c = 0; c < p.chains; ++c, outer *= p.sizes[c - 1]) {
      const int size = p.sizes[c];
      inner /= size;
      const Model& t = p.trans[c];
      if (!t.data) continue;
      if (t.row) {
        load_model(t, first, p.n_tracks, k, trans);
        steps.lanes.mix(state, law, n, outer, size, inner, trans, logs, heap);
      } else {
        steps.shared.mix(state, law, n, outer, size, inner, address(t, 0, k), logs, heap);
      }
    }
    if (logs) logs = still_in_logs(law, p.modes);
    if (dynamics_by_lane)
      steps.lanes.propagate(state, n, p.modes, by_lane(p.F, k, F, 0), by_lane(p.b, k, b, 0), by_lane(p.Q, k, Q, n),
                            heap);
    else
      steps.shared.propagate(state, n, p.modes, shared(p.F, k), shared(p.b, k), shared(p.Q, k), heap);
  }

  void update(Size k, int slot, bool keep, V* out) {
    V seen{};
    for (int a = 0; a < m; ++a) {
      const V value = z_raw[slot * m + a];
      const I known = value == value;
      z[a] = select(known, value, V{});
      on[a] = select(known, splat(1.0), V{});
      seen += on[a];
    }
    V *nis = out + record + p.modes, *n_observed = nis + 1, *log_likelihood = nis + 2;
    *n_observed = seen;
    I bad;
    if (sensor_by_lane)
      bad = steps.lanes.update(state, n, m, p.modes, by_lane(p.H, k, H, 0), by_lane(p.d, k, d, 0), by_lane(p.R, k, R, m),
                               z, on, report, heap);
    else
      bad = steps.shared.update(state, n, m, p.modes, shared(p.H, k), shared(p.d, k), shared(p.R, k), z, on, report,
                                heap);
    if (any(bad)) status |= kNotPositive;
    if (keep) {
      probabilities(law, logs, p.modes, probs);
      *nis = steps.nis(report, probs, m, p.modes, heap);
    }
    *log_likelihood = reweigh(law, logs, p.modes, m, report, seen, heap);
  }

  void output(V* out) {
    V* law_out = out + record;
    probabilities(law, logs, p.modes, law_out);
    steps.collapse(state, law_out, n, p.modes, out, heap);
  }

  void store_steps(Size k, int slot) {
    if (p.mode_means && (p.every || k == p.n_steps - 1)) {
      const Size rows = p.every ? p.n_steps : 1, row = p.every ? k : 0;
      for (const Field* f = by_mode_fields; f < by_mode_fields + 2; ++f)
        store_lanes(state, f->index, f->width, f->out + (first * rows + row) * f->width, rows * f->width, tracks);
    }
    if (slot != W - 1 && k != p.n_steps - 1) return;
    store_field(fields[kLikelihood], k - slot, slot + 1, p.n_steps, 0);
    if (p.every)
      for (int f = 0; f < kLikelihood; ++f) store_field(fields[f], k - slot, slot + 1, p.n_steps, 0);
    else if (k == p.n_steps - 1)
      for (int f = 0; f < kLikelihood; ++f) store_field(fields[f], 0, 1, 1, slot);
  }

  void store_field(const Field& f, Size row, int slots, Size rows, int from_slot) {
    store_lanes(buffer, f.index + from_slot * f.width, slots * f.width, f.out + (first * rows + row) * f.width,
                rows * f.width, tracks);
  }

  const Problem& p;
  const int n, m, record;
  const Stages steps;
  const bool dynamics_by_lane, sensor_by_lane;
  Size first = 0;
  int tracks = W, status = kFine, slot_size = 0;
  std::size_t used_ = 0;
  bool logs = true;
  V *heap, *state, *law, *probs, *report, *z_raw, *z, *on, *F, *b, *Q, *H, *d, *R, *prior, *trans, *buffer;
  Field fields[kFields], by_mode_fields[2];
};

}  // namespace saltus::SALTUS_NS
