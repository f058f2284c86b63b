// What the binding and the units compiled per instruction set tell each other. Plain structs: no inline code to share.
#pragma once

#include <cstddef>
#include <cstdint>

namespace saltus {

// A model array (rows | 1, T | 1, M1 | 1, ..., MC | 1, core), C contiguous. Absent axes have stride 0; `rows` maps a
// track to its row where that is not the track's own number. Mode j has its elements at which[j] * core.
struct Model {
  const double* data = nullptr;
  const std::int64_t* rows = nullptr;
  std::ptrdiff_t row = 0, time = 0;  // strides, in doubles
  int distinct = 1, core = 1;
  const int* which = nullptr;
};

// kDoubtful: a model array given per track holds NaN, inf, or a covariance that is not exactly symmetric or has
// negative pivots. Such arrays are too large to be read twice, so they are checked as they are loaded.
// kNotPositive, kTooFar, kNotFinite: a row that has no likelihood, as its Fault says.
enum Status : int { kFine = 0, kNotPositive = 1, kInfinite = 2, kDoubtful = 4, kTooFar = 8, kNotFinite = 16 };

// Why a track was given up, and where: one Status, the row, the component. Three columns, so that they are an array.
struct Fault {
  std::int64_t kind, row, component;
};

struct Problem {
  std::ptrdiff_t n_tracks = 0, n_steps = 0;
  int n = 0, m = 0, modes = 1, chains = 0;
  int reported = 0;  // the moments of the first components only are written
  int start = 0;  // 1: the prior holds at the first measurement, and arrays over intervals begin with the second
  // 0, or m where from the first measurement on the state is `map` times that of the prior, and its last m components
  // are what is measured, without noise: they leave while known. H, R and d are those of the first measurement, and Q
  // has rows [Q | cov(e, f) | M] of `advance`.
  int known = 0;
  const int* sizes = nullptr;
  const double* z = nullptr;  // (tracks, T, m), NaN where missing
  Model F, b, Q, H, d, R, map;
  const Model* trans = nullptr;  // one per chain; data is null where the chain cannot switch
  Model log_probs0, mean0, cov0;
  bool every = true;  // all rows, or the last one only
  // (tracks, rows, ...); the modes' moments are null unless wanted, log_likelihood always has every row.
  double *probs = nullptr, *mean = nullptr, *cov = nullptr, *log_likelihood = nullptr, *nis = nullptr;
  double *n_observed = nullptr, *mode_means = nullptr, *mode_covs = nullptr;
  Fault* faults = nullptr;  // (tracks,), of the first row that had one
};

// Tracks in lanes: block r / lanes holds [log P(modes) | a record per mode], each element once per lane.
struct Tracks {
  double* data = nullptr;
  int n = 0, modes = 1, chains = 0;
  const int* sizes = nullptr;
};

struct Rows {
  const std::int64_t* index = nullptr;
  std::ptrdiff_t count = 0;
};

// Where particles may go: P(next mode | now) by rows, the mode of each row, and per mode the first of equal dynamics.
struct Branches {
  int modes = 1;
  const double* trans = nullptr;
  const std::int64_t* now = nullptr;
  const std::int64_t* same = nullptr;
};

// One instruction set. Workspaces are counted in doubles and aligned to 64 bytes by the caller.
struct Kernel {
  const char* name;
  int lanes;
  std::size_t (*filter_workspace)(const Problem&);
  int (*filter)(const Problem&, std::ptrdiff_t first_block, std::ptrdiff_t last_block, double* workspace);
  std::size_t (*bank_workspace)(const Tracks&, int m);
  std::size_t (*block_size)(const Tracks&);  // doubles
  // Returns kDoubtful, and has done nothing, where the arrays are.
  int (*bank_step)(const Tracks&, Rows, const Model* trans, const Model& F, const Model& b, const Model& Q,
                    double* workspace);
  // Measures rows, and conditions them when `write`; z is (count, m), d2 and log_likelihood (count,). Returns the first
  // fault (kDoubtful: nothing was done); a row that is only measured may be too far away, with a log-likelihood of -inf.
  Fault (*bank_measure)(const Tracks&, Rows, bool write, int m, const double* z, const Model& H, const Model& d,
                      const Model& R, double* d2, double* log_likelihood, double* workspace);
  void (*bank_moments)(const Tracks&, Rows, double* mean, double* cov, double* probs, double* workspace);
  void (*bank_read)(const Tracks&, Rows, double* log_probs, double* means, double* covs, double* workspace);
  void (*bank_write)(const Tracks&, Rows, const double* log_probs, const double* means, const double* covs);
  std::size_t (*expand_workspace)(const Tracks&, int modes, int m);
  // z is (count, m), law (count, modes), log_likelihood (count,). A row may be too far away for every mode.
  Fault (*bank_expand)(const Tracks&, Rows, const Branches&, int m, const double* z, const Model& F, const Model& b,
                     const Model& Q, const Model& H, const Model& d, const Model& R, double* law,
                     double* log_likelihood, double* workspace);
  // `totals` is scratch, as many doubles as mass, means and covs together.
  void (*bank_merge)(const Tracks&, Rows, const double* weight, const std::int64_t* label, std::ptrdiff_t labels,
                     double* mass, double* means, double* covs, double* totals, double* workspace);
  // Row i of `to` becomes the mixture of the copies start[i] .. start[i + 1] - 1, whose weights in logs are normalised.
  void (*bank_merge_copies)(const Tracks& copies, const std::int64_t* start, const double* log_weight, const Tracks& to,
                            Rows target, double* workspace);
  void (*bank_copy)(const Tracks& from, Rows source, const Tracks& to, Rows target);
  // Does `rounds` x 16 x lanes independent fused multiply-adds: what the core can do at most.
  double (*multiply_adds)(std::int64_t rounds);
};

// Null where this build has no such unit.
extern const Kernel* const kBaseline;
extern const Kernel* const kAvx2;
extern const Kernel* const kAvx512;

}  // namespace saltus
