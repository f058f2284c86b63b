// The steps as functions by size: the loops over time and over a bank are compiled once, these once per n and m.
#pragma once

#include "measure.hpp"

namespace saltus::SALTUS_NS {

template <class E>
struct StagesOf {
  void (*mix)(V* state, V* law, int n, int outer, int size, int inner, const E* trans, bool logs, V* heap);
  void (*propagate)(V* state, int n, int modes, ByMode<E> F, ByMode<E> b, ByMode<E> Q, V* heap);
  I (*update)(V* state, int n, int m, int modes, ByMode<E> H, ByMode<E> d, ByMode<E> R, const V* z, const V* on,
              V* report, V* heap);
  I (*score)(V* state, int n, int m, int modes, ByMode<E> H, ByMode<E> d, ByMode<E> R, const V* z, const V* on,
             V* report, V* heap);
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

// Each unit knows its own n; 0 is any size.
using Lookup = Stages (*)(int n, int m);
Stages stages_1_to_4(int n, int m);
Stages stages_5(int n, int m);
Stages stages_6(int n, int m);
Stages stages_others(int n, int m);

inline Stages stages(int n, int m) {
  if (m > 4 || n > 9) return stages_others(0, 0);
  const Lookup unit = n <= 4 ? stages_1_to_4 : n == 5 ? stages_5 : n == 6 ? stages_6 : stages_others;
  return unit(n, m);
}

// Doubles per lane of scratch that any step may ask for.
inline std::size_t heap_size(int n, int m, int largest_chain) {
  const std::size_t record = n + triangle(n), K = largest_chain;
  return K * (K + 1 + record) + 4 * record + 3 * std::size_t(n) * m + 2 * triangle(m) + 8 * m + 8;
}

}  // namespace saltus::SALTUS_NS
