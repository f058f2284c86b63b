// From the lanes of one block to the rows of the output arrays, many rows at once.
#pragma once

#include "rows.hpp"
#include "step.hpp"

namespace saltus::SALTUS_NS {

SALTUS_INLINE constexpr int record_size(int n) { return n + triangle(n); }

// The first r components of a record [x | P] of n; source and target may overlap where the target begins no later.
inline void leading(const V* source, int n, V* target, int r) {
  for (int i = 0; i < r; ++i) target[i] = source[i];
  for (int i = 0; i < triangle(r); ++i) target[r + i] = source[n + i];
}

// One output array: `width` doubles per row of a track, gathered from the step's slot of the buffer.
struct Field {
  double* out;
  int width;
  int* index;  // for all slots of the buffer, so that whole runs of rows are stored at once
};

// A buffer of W slots, one per step: [mean | covariance | P(modes) | nis | n_observed | log_likelihood].
class Output {
 public:
  Output(const Problem& problem, Arena& arena) : p(problem), r(problem.reported), law(record_size(r)) {
    slot_size = law + p.modes + 3;
    buffer = arena.take(std::size_t(W) * slot_size);
    const int widths[kFields] = {r, r * r, p.modes, 1, 1, 1};
    for (int f = 0; f < kFields; ++f) fields[f] = {nullptr, widths[f], arena.take_ints(std::size_t(W) * widths[f])};
    for (int layout = 0; p.mode_means && layout < 2; ++layout) {
      by_mode[layout][0] = {p.mode_means, p.modes * r, arena.take_ints(std::size_t(p.modes) * r)};
      by_mode[layout][1] = {p.mode_covs, p.modes * r * r, arena.take_ints(std::size_t(p.modes) * r * r)};
    }
    if (arena.base) plan();
  }

  V* slot(Size k) const { return buffer + (k % W) * slot_size; }
  V* probs(V* out) const { return out + law; }
  V& nis(V* out) const { return out[law + p.modes]; }
  V& n_observed(V* out) const { return out[law + p.modes + 1]; }
  V& log_likelihood(V* out) const { return out[law + p.modes + 2]; }

  // After step k of the block that begins with track `first`; the modes' records hold n components.
  void store(const V* state, int n, Size first, int tracks, Size k) const {
    const bool last = k == p.n_steps - 1;
    if (p.mode_means && (p.every || last)) {
      const Size rows = p.every ? p.n_steps : 1, row = p.every ? k : 0;
      for (const Field& f : by_mode[n != p.n])
        store_lanes(state, f.index, f.width, f.out + (first * rows + row) * f.width, rows * f.width, tracks);
    }
    const int slot = int(k % W);
    if (slot != W - 1 && !last) return;
    store_field(fields[kLikelihood], first, tracks, k - slot, slot + 1, p.n_steps, 0);
    for (int f = 0; f < kLikelihood; ++f) {
      if (p.every)
        store_field(fields[f], first, tracks, k - slot, slot + 1, p.n_steps, 0);
      else if (last)
        store_field(fields[f], first, tracks, 0, 1, 1, slot);
    }
  }

 private:
  static constexpr int kFields = 6, kLikelihood = 5;  // mean, cov, probs, nis, n_observed, log_likelihood

  void plan() {
    double* const out[kFields] = {p.mean, p.cov, p.probs, p.nis, p.n_observed, p.log_likelihood};
    for (int slot = 0; slot < W; ++slot) {
      const int at = slot * slot_size, after = at + law + p.modes;
      const int offset[kFields] = {at, at + r, at + law, after, after + 1, after + 2};
      for (int f = 0; f < kFields; ++f) {
        Field& field = fields[f];
        field.out = out[f];
        int* index = field.index + slot * field.width;
        if (f == 1)
          symmetric_index(r, offset[f], index);
        else
          for (int i = 0; i < field.width; ++i) index[i] = offset[f] + i;
      }
    }
    for (int layout = 0; p.mode_means && layout < 2; ++layout)
      for (int mode = 0; mode < p.modes; ++mode) {
        const int n = layout ? p.n - p.known : p.n, at = mode * record_size(n);
        for (int i = 0; i < r; ++i) by_mode[layout][0].index[mode * r + i] = at + i;
        symmetric_index(r, at + n, by_mode[layout][1].index + mode * r * r);
      }
  }

  void store_field(const Field& f, Size first, int tracks, Size row, int slots, Size rows, int from_slot) const {
    store_lanes(buffer, f.index + from_slot * f.width, slots * f.width, f.out + (first * rows + row) * f.width,
                rows * f.width, tracks);
  }

  const Problem& p;
  const int r, law;
  int slot_size = 0;
  V* buffer;
  Field fields[kFields], by_mode[2][2];  // of the whole state, and of what is kept where the measured part is known
};

}  // namespace saltus::SALTUS_NS
