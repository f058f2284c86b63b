// P(modes) of the lanes of one block, linear while that is safe and in logs when it is not.
#pragma once

#include "kernel.hpp"
#include "measure.hpp"

namespace saltus::SALTUS_NS {

inline constexpr double kLog2Pi = 1.8378770664093453;
// Below e^-460 (1e-200) of the likeliest mode a law is carried in logs: nothing is lost to underflow, and no outlier,
// however gross, flattens the modes. Above, one exponential per mode and step does.
inline constexpr double kLinearFloor = -460.0;

// Turn a law in logs into a linear one where every lane allows it; returns whether it is still in logs.
inline bool still_in_logs(V* law, int modes) {
  I low{};
  for (int j = 0; j < modes; ++j) low |= (law[j] < kLinearFloor) & (law[j] > -__builtin_inf());
  if (any(low)) return true;
  for (int j = 0; j < modes; ++j) law[j] = exponential(law[j]);
  return false;
}

inline void into_logs(V* law, int modes) {
  for (int j = 0; j < modes; ++j) law[j] = logarithm(law[j]);
}

// Bayes' rule with every number of a moderate size; false, and nothing changed, when some lane needs logs. MODES is
// their number when known to the compiler, 0 otherwise.
template <int MODES>
inline bool reweigh_linear(V* law, int size_modes, int size, const V* report, V seen, V* heap, V& evidence) {
  const int modes = MODES > 0 ? MODES : size_modes;
  Local<MODES> joint(heap, modes);
  V least = report[0];
  from<MODES>(1, modes, [&](int j) SALTUS_LAMBDA { least = minimum(report[j * size], least); });
  V sum{}, weakest = splat(__builtin_inf());
  each<MODES>(modes, [&](int j) SALTUS_LAMBDA {
    const V* r = report + j * size;
    joint[j] = law[j] * square_root(r[1]) * exponential(-0.5 * (r[0] - least));
    weakest = select(law[j] > 0.0, minimum(joint[j], weakest), weakest);
    sum += joint[j];
  });
  const I safe = (sum > 1e-250) & (sum < 1e250) & (weakest >= sum * 1e-200);
  if (any(~safe)) return false;
  const V scale = reciprocal(sum);
  each<MODES>(modes, [&](int j) SALTUS_LAMBDA { law[j] = joint[j] * scale; });
  if (modes == 1) law[0] = splat(1.0);  // not to the last bit: exactly
  evidence = logarithm(sum) - 0.5 * (least + seen * kLog2Pi);
  return true;
}

inline V reweigh_logs(V* law, int modes, int m, const V* report, V seen) {
  V top = splat(-__builtin_inf());
  for (int j = 0; j < modes; ++j, report += report_size(m)) {
    V log_det{};
    for (int a = 0; a < m; ++a) log_det += logarithm(report[2 + a]);
    law[j] -= 0.5 * (report[0] + log_det);
    top = maximum(top, law[j]);
  }
  // The greatest first: at 1e16 the logarithm of the sum is rounded to 2, and nothing would sum to 1.
  top = select(top > -__builtin_inf(), top, V{});
  V sum{};
  for (int j = 0; j < modes; ++j) sum += exponential(law[j] -= top);
  const V total = logarithm(sum);
  for (int j = 0; j < modes; ++j) law[j] -= total;
  return total + top - 0.5 * seen * kLog2Pi;
}

// law <- P(modes | z), returns log f(z): 0 where nothing was seen. `heap` holds one number per mode.
inline V reweigh(V* law, bool& logs, int modes, int m, const V* report, V seen, V* heap) {
  V evidence;
  const auto linear = modes == 2 ? reweigh_linear<2> : modes == 4 ? reweigh_linear<4> : reweigh_linear<0>;
  if (logs || !linear(law, modes, report_size(m), report, seen, heap, evidence)) {
    if (!logs) into_logs(law, modes);
    logs = true;
    evidence = reweigh_logs(law, modes, m, report, seen);
  }
  return select(seen > 0.0, evidence, V{});
}

// Why lane l of a measured row has no likelihood, by the reports of its modes.
inline Fault fault_of(const V* report, int modes, int m, int l) {
  int component = 0;
  double least = __builtin_inf();
  const int size = report_size(m);
  for (const V* r = report; r < report + modes * size; r += size) {
    double worst = -1.0;
    int at = 0;
    for (int a = 0; a < m; ++a) {
      const double nu = r[2 + m + a][l], S = r[2 + 2 * m + packed(a, a)][l], away = __builtin_fabs(nu) / __builtin_sqrt(S);
      if (!(nu - nu == 0.0) || !(S - S == 0.0)) return {kNotFinite, 0, a};
      if (!certain(r[2 + a][l], S)) return {kNotPositive, 0, a};
      if (away > worst) worst = away, at = a;
    }
    if (worst < least) least = worst, component = at;
  }
  return {kTooFar, 0, component};
}

// Lanes whose row has no likelihood: as a rule too far counts, where it is only looked at it does not.
inline I lost_lanes(V log_likelihood, bool too_far) {
  I lost = ~finite(log_likelihood);
  if (!too_far) lost &= ~(log_likelihood == -__builtin_inf());
  return lost;
}

inline void probabilities(const V* law, bool logs, int modes, V* probs) {
  for (int j = 0; j < modes; ++j) probs[j] = logs ? exponential(law[j]) : law[j];
}

}  // namespace saltus::SALTUS_NS
