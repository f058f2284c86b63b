// The steps as functions by size: the loops over time and over a bank are compiled once, these once per n and m.
#pragma once

#include "measure.hpp"

namespace saltus::SALTUS_NS {

template <class E>
struct StagesOf {
  void (*mix)(V* state, V* law, int n, int outer, int size, int inner, const E* trans, bool logs, V* heap);
  void (*propagate)(V* state, int n, int modes, ByMode<E> F, ByMode<E> b, ByMode<E> Q, V* heap);
  // Measures every mode, and conditions it if `write`.
  I (*update)(V* state, int n, int m, int modes, ByMode<E> H, ByMode<E> d, ByMode<E> R, const V* z, const V* on,
              V* report, V* heap, bool write);
  // Where what was measured is known, and left the state; and where it is in the state.
  I (*advance)(V* state, int n, int m, int modes, ByMode<E> Phi, ByMode<E> b, ByMode<E> noise, const V* known,
               const V* z, const V* on, V* report, V* heap);
  I (*advance_inside)(V* state, int n, int m, int modes, ByMode<E> Phi, ByMode<E> b, ByMode<E> noise, const V* known,
                      const V* z, const V* on, V* report, V* heap);
};

struct Stages {
  StagesOf<double> shared;
  StagesOf<V> lanes;
  void (*collapse)(const V* state, const V* probs, int n, int modes, V* out, V* heap);
  V (*nis)(const V* report, const V* probs, int m, int modes, V* heap);
};

// Each unit knows its own n, but for the last, which takes any.
using Lookup = Stages (*)(int n, int m);
Stages stages_1_to_4(int n, int m);
Stages stages_5(int n, int m);
Stages stages_6(int n, int m);
Stages stages_any(int n, int m);

inline Stages stages(int n, int m) {
  const Lookup unit = m > 4 || n > 6 ? stages_any : n <= 4 ? stages_1_to_4 : n == 5 ? stages_5 : stages_6;
  Stages found = unit(n, m);
  if (unit == stages_any) return found;
  const Stages any = stages_any(n, m);
  found.shared.advance_inside = any.shared.advance_inside;
  found.lanes.advance = any.lanes.advance, found.lanes.advance_inside = any.lanes.advance_inside;
  return found;
}

// Doubles per lane of scratch that any step may ask for.
inline std::size_t heap_size(int n, int m, int largest_chain) {
  const std::size_t record = n + triangle(n), K = largest_chain, wide = n + m;
  return K * (K + 1 + record) + 3 * record + triangle(m) + std::size_t(n) * n + wide * (wide + 4) + 4 * wide + 8;
}

}  // namespace saltus::SALTUS_NS
