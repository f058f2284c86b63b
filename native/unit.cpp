// The kernel of one instruction set: SALTUS_NS names it, SALTUS_KERNEL is where the dispatcher finds it.
#include "particles.hpp"
#include "recursion.hpp"

#define SALTUS_STRING(x) #x
#define SALTUS_NAME(x) SALTUS_STRING(x)

namespace saltus::SALTUS_NS {
namespace {

Arena arena(double* workspace) { return {reinterpret_cast<V*>(workspace), 0}; }

std::size_t filter_workspace(const Problem& p) { return Recursion(p, {}).used() * W; }

int filter(const Problem& p, Size first_block, Size last_block, double* workspace) {
  return Recursion(p, arena(workspace)).run(first_block, last_block);
}

std::size_t bank_workspace(const Tracks& t, int m) {
  V *copy, *law, *heap;
  std::size_t models = 0;
  const std::size_t n = t.n;
  for (int c = 0; c < t.chains; ++c) models += std::size_t(t.sizes[c]) * t.sizes[c];
  models += std::size_t(t.modes) * (2 * n * n + n + m * n + m + std::size_t(m) * m);
  models += std::size_t(t.modes) * (report_size(m) + 1) + 2 * m + record_of(t) + n * n + 64;
  return (bank_space(t, m, {}, &copy, &law, &heap) + models) * W;
}

std::size_t block_size(const Tracks& t) { return block_of(t) * W; }

int bank_step(const Tracks& t, Rows rows, const Model* trans, const Model& F, const Model& b, const Model& Q,
              double* workspace) {
  return step_rows(t, rows, trans, F, b, Q, arena(workspace));
}

Fault bank_measure(const Tracks& t, Rows rows, bool write, int m, const double* z, const Model& H, const Model& d,
                 const Model& R, double* d2, double* log_likelihood, double* workspace) {
  return measure_rows(t, rows, write, m, z, H, d, R, d2, log_likelihood, arena(workspace));
}

void bank_moments(const Tracks& t, Rows rows, double* mean, double* cov, double* probs, double* workspace) {
  moments_of_rows(t, rows, mean, cov, probs, arena(workspace));
}

void bank_read(const Tracks& t, Rows rows, double* log_probs, double* means, double* covs, double* workspace) {
  read_rows(t, rows, log_probs, means, covs, arena(workspace));
}

void bank_write(const Tracks& t, Rows rows, const double* log_probs, const double* means, const double* covs) {
  write_rows(t, rows, log_probs, means, covs);
}

std::size_t expand_workspace(const Tracks& t, int modes, int m) {
  V *copy, *states, *law, *report, *value, *on, *heap;
  return (expand_space(t, modes, m, {}, &copy, &states, &law, &report, &value, &on, &heap) + modes + 1) * W;
}

Fault bank_expand(const Tracks& t, Rows rows, const Branches& to, int m, const double* z, const Model& F, const Model& b,
                const Model& Q, const Model& H, const Model& d, const Model& R, double* law, double* log_likelihood,
                double* workspace) {
  return expand_rows(t, rows, to, m, z, F, b, Q, H, d, R, law, log_likelihood, arena(workspace));
}

void bank_merge(const Tracks& t, Rows rows, const double* weight, const std::int64_t* label, Size labels, double* mass,
                double* means, double* covs, double* totals, double* workspace) {
  merge_rows(t, rows, weight, label, labels, mass, means, covs, totals, arena(workspace));
}

void bank_merge_copies(const Tracks& copies, const std::int64_t* start, const double* log_weight, const Tracks& to,
                       Rows target, double* workspace) {
  merge_copies(copies, start, log_weight, to, target, arena(workspace));
}

double multiply_adds(std::int64_t rounds) {
  V sums[16];
  for (int i = 0; i < 16; ++i) sums[i] = splat(double(i));
  const V factor = splat(0.999), term = splat(1e-3);
  for (std::int64_t k = 0; k < rounds; ++k) {
#pragma GCC unroll 16
    for (int i = 0; i < 16; ++i) sums[i] = sums[i] * factor + term;
  }
  V total{};
  for (int i = 0; i < 16; ++i) total += sums[i];
  return total[0];
}

const Kernel kernel{SALTUS_NAME(SALTUS_NS), W,          filter_workspace, filter,    bank_workspace, block_size,
                    bank_step,              bank_measure, bank_moments,     bank_read, bank_write,     expand_workspace,
                    bank_expand,            bank_merge,   bank_merge_copies, copy_rows,        multiply_adds};

}  // namespace
}  // namespace saltus::SALTUS_NS

namespace saltus {
const Kernel* const SALTUS_KERNEL = &SALTUS_NS::kernel;
}
