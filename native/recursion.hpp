// The recursion along time for one block of tracks after another: mix, propagate, measure, condition, reweigh, store.
#pragma once

#include "law.hpp"
#include "output.hpp"
#include "stages.hpp"

namespace saltus::SALTUS_NS {

class Recursion {
 public:
  Recursion(const Problem& problem, Arena arena)
      : p(problem),
        m(problem.m),
        full(stages(p.n, m)),
        reduced(stages(p.n - p.known, m)),
        dynamics_by_lane(p.F.row || p.b.row || p.Q.row),
        sensor_by_lane(p.H.row || p.d.row || p.R.row),
        output(problem, arena) {
    divide(arena);
    used_ = arena.used;
  }

  std::size_t used() const { return used_; }

  int run(Size first_block, Size last_block) {
    for (Size block = first_block; block < last_block; ++block) {
      first = block * W;
      tracks = p.n_tracks - first < W ? int(p.n_tracks - first) : W;
      load_prior();
      for (Size k = 0; k < p.n_steps; ++k) {
        if (k % W == 0) load_measurements(k);
        read_measurement(k);
        if (k >= p.start) mix(k - p.start);
        update(k);
        weigh(k);
        if (p.every || k == p.n_steps - 1) collapse(output.slot(k), k);
        output.store(state, n, first, tracks, k);
      }
    }
    return status;
  }

 private:
  void divide(Arena& arena) {
    int largest = 2;
    for (int c = 0; c < p.chains; ++c) largest = p.sizes[c] > largest ? p.sizes[c] : largest;
    heap = arena.take(heap_size(p.n, m, largest) + p.modes);
    state = arena.take(std::size_t(p.modes) * record_size(p.n));
    moments = arena.take(record_size(p.n));
    law = arena.take(p.modes);
    probs = arena.take(p.modes);
    report = arena.take(std::size_t(p.modes) * report_size(m));
    z_raw = arena.take(W * m);
    z = arena.take(m), known = arena.take(m);
    on = arena.take(m);
    F = arena.take(lanes_of(p.F)), b = arena.take(lanes_of(p.b)), Q = arena.take(lanes_of(p.Q));
    H = arena.take(lanes_of(p.H)), d = arena.take(lanes_of(p.d)), R = arena.take(lanes_of(p.R));
    prior = arena.take(lanes_of(p.mean0) + lanes_of(p.cov0));
    std::size_t largest_trans = 0;
    for (int c = 0; c < p.chains; ++c)
      if (lanes_of(p.trans[c]) > largest_trans) largest_trans = lanes_of(p.trans[c]);
    trans = arena.take(largest_trans);
    if (!p.known) return;
    const int size = p.n * p.n, pieces = size / W + 1;
    nothing = reinterpret_cast<double*>(arena.take(pieces));
    none = arena.take_ints(p.modes);
    for (int i = 0; arena.base && i < size; ++i) nothing[i] = 0.0;
    for (int i = 0; arena.base && i < p.modes; ++i) none[i] = 0;
  }

  void load_prior() {
    V *mean = prior, *cov = prior + lanes_of(p.mean0);
    load_model(p.mean0, first, p.n_tracks, 0, mean);
    load_model(p.cov0, first, p.n_tracks, 0, cov);
    load_model(p.log_probs0, first, p.n_tracks, 0, law);
    n = p.n;
    for (int mode = 0; mode < p.modes; ++mode) {
      V* x = state + mode * record_size(n);
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

  void read_measurement(Size k) {
    I missing{};
    seen = V{};
    for (int a = 0; a < m; ++a) {
      const V value = z_raw[(k % W) * m + a];
      const I known = value == value;
      missing |= ~known;
      z[a] = select(known, value, V{});
      on[a] = select(known, splat(1.0), V{});
      seen += on[a];
    }
    complete = !any(missing);
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
      if (model.row && any(doubtful(model, staged, order, heap))) status |= kDoubtful;
    }
    return by_mode<V>(model, staged);
  }

  const Stages& steps() const { return n == p.n ? full : reduced; }

  void mix(Size k) {
    int outer = 1, inner = p.modes;
    for (int c = 0; c < p.chains; ++c, outer *= p.sizes[c - 1]) {
      const int size = p.sizes[c];
      inner /= size;
      const Model& t = p.trans[c];
      if (!t.data) continue;
      if (t.row) {
        load_model(t, first, p.n_tracks, k, trans);
        steps().lanes.mix(state, law, n, outer, size, inner, trans, logs, heap);
      } else {
        steps().shared.mix(state, law, n, outer, size, inner, address(t, 0, k), logs, heap);
      }
    }
    if (logs) logs = still_in_logs(law, p.modes);
  }

  void propagate(Size k) {
    if (dynamics_by_lane)
      full.lanes.propagate(state, n, p.modes, by_lane(p.F, k, F, 0), by_lane(p.b, k, b, 0), by_lane(p.Q, k, Q, n), heap);
    else
      full.shared.propagate(state, n, p.modes, shared(p.F, k), shared(p.b, k), shared(p.Q, k), heap);
  }

  I advance(Size k) {
    const Stages& s = steps();
    if (dynamics_by_lane)
      return (n < p.n ? s.lanes.advance : s.lanes.advance_inside)(state, n, m, p.modes, by_lane(p.F, k, F, 0),
                                                                  by_lane(p.b, k, b, 0), by_lane(p.Q, k, Q, 0), known,
                                                                  z, on, report, heap);
    return (n < p.n ? s.shared.advance : s.shared.advance_inside)(state, n, m, p.modes, shared(p.F, k), shared(p.b, k),
                                                                  shared(p.Q, k), known, z, on, report, heap);
  }

  I measure(Size k) {
    if (sensor_by_lane)
      return full.lanes.update(state, n, m, p.modes, by_lane(p.H, k, H, 0), by_lane(p.d, k, d, 0),
                               by_lane(p.R, k, R, m), z, on, report, heap, true);
    return full.shared.update(state, n, m, p.modes, shared(p.H, k), shared(p.d, k), shared(p.R, k), z, on, report, heap,
                              true);
  }

  void update(Size k) {
    const Size moved = k - p.start;  // the row of the dynamics; none where the prior holds at the first measurement
    I bad;
    if (p.known && moved >= 0) {
      if (n < p.n && !complete) widen();
      bad = advance(moved);
    } else {
      if (moved >= 0) propagate(moved);
      bad = measure(k);
      if (p.known) full.shared.propagate(state, n, p.modes, shared(p.map, 0), {}, {nothing, none, 0}, heap);
    }
    if (p.known) settle();
    if (any(bad)) note(bad, k);
  }

  void weigh(Size k) {
    const bool keep = p.every || k == p.n_steps - 1;
    V* out = output.slot(k);
    output.n_observed(out) = seen;
    if (keep) {
      probabilities(law, logs, p.modes, probs);
      output.nis(out) = full.nis(report, probs, m, p.modes, heap);
    }
    const V evidence = reweigh(law, logs, p.modes, m, report, seen, heap);
    output.log_likelihood(out) = evidence;
    const I lost = ~finite(evidence);
    if (any(lost)) note(lost, k);
  }

  // Say of the lanes given up why and where, each once.
  void note(I lanes, Size k) {
    for (int l = 0; l < tracks; ++l) {
      Fault& fault = p.faults[first + l];
      if (!lanes[l] || fault.kind != kFine) continue;
      fault = fault_of(report, p.modes, m, l);
      fault.row = k;
      status |= int(fault.kind);
    }
  }

  // What is measured are the last components of the state: take them back in, as known as the last row left them.
  void widen() {
    const int kept = n, size = record_size(p.n);
    for (int mode = p.modes - 1; mode >= 0; --mode) {
      const V* source = state + mode * record_size(kept);
      V *x = state + mode * size, *P = x + p.n;
      for (int i = triangle(kept) - 1; i >= 0; --i) P[i] = source[kept + i];
      for (int i = kept - 1; i >= 0; --i) x[i] = source[i];
      for (int a = 0; a < m; ++a) x[kept + a] = known[a];
      for (int i = triangle(kept); i < triangle(p.n); ++i) P[i] = V{};
    }
    n = p.n;
  }

  // Drop them where all of them are known in every lane; else give what was seen its value and no variance, which
  // rounding must not make uncertain again, and round the variance of the others up: x and y move together in a gap,
  // and rounding must not make them more alike than they can be.
  void settle() {
    const int kept = p.n - p.known, size = record_size(p.n);
    for (int a = 0; a < m; ++a) known[a] = z[a];
    if (n < p.n) return;
    if (complete) {
      for (int mode = 0; mode < p.modes; ++mode)
        leading(state + mode * size, p.n, state + mode * record_size(kept), kept);
      n = kept;
      return;
    }
    for (V* x = state; x < state + p.modes * size; x += size)
      for (int a = 0; a < m; ++a) {
        const int i = kept + a;
        const V unseen = 1.0 - on[a];
        x[i] = select(on[a] != 0.0, z[a], x[i]);
        for (int j = 0; j < p.n; ++j) x[p.n + packed(i, j)] *= unseen;
        x[p.n + packed(i, i)] *= 1.0 + 0x1p-48;
      }
  }

  void collapse(V* out, Size k) {
    probabilities(law, logs, p.modes, output.probs(out));
    V* target = n == p.reported ? out : moments;
    steps().collapse(state, output.probs(out), n, p.modes, target, heap);
    if (target == moments) leading(moments, n, out, p.reported);
    V rest{};
    for (int i = 0; i < p.reported; ++i) rest += 0.0 * out[i] + 0.0 * out[p.reported + packed(i, i)];
    if (any(rest != 0.0)) overflowed(rest != 0.0, k);
  }

  void overflowed(I lanes, Size k) {
    for (int l = 0; l < tracks; ++l)
      if (lanes[l] && p.faults[first + l].kind == kFine) p.faults[first + l] = {kNotFinite, k, 0}, status |= kNotFinite;
  }

  const Problem& p;
  const int m;
  const Stages full, reduced;  // for all of the state, and for what is kept while the measured components are known
  const bool dynamics_by_lane, sensor_by_lane;
  Output output;
  Size first = 0;
  int tracks = W, n = 0;  // n components are in the records now
  std::size_t used_ = 0;
  int status = kFine;
  bool logs = true, complete = false;
  V seen{};
  V *heap, *state, *moments, *law, *probs, *report, *z_raw, *z, *known, *on, *F, *b, *Q, *H, *d, *R, *prior, *trans;
  double* nothing = nullptr;  // a covariance of zero, in every mode
  int* none = nullptr;
};

}  // namespace saltus::SALTUS_NS
