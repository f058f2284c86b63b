// Instantiates the steps for the sizes SALTUS_FIRST_N .. SALTUS_LAST_N, as the lookup SALTUS_LOOKUP.
#include "stages.hpp"

namespace saltus::SALTUS_NS {

template <int N, int M, class E>
constexpr StagesOf<E> of() {
  // Where noise is coloured, runs that move each in its own way are rare, and so are gaps: sizes known at run time,
  // compiled once, will do (`stages`).
  constexpr bool any = N == 0, common = any || sizeof(E) == sizeof(double);
  StagesOf<E> found{mix<N, E>, propagate<N, E>, measure<N, M, E>, nullptr, nullptr};
  if constexpr (common) found.advance = advance<N, M, E, false>;
  if constexpr (any) found.advance_inside = advance<N, M, E, true>;
  return found;
}

template <int N, int M>
constexpr Stages make() {
  return Stages{of<N, M, double>(), of<N, M, V>(), collapse<N>, mixture_nis<M>};
}

template <int N>
Stages by_m(int m) {
  switch (m) {
    case 1: return make<N, 1>();
    case 2: return make<N, 2>();
    case 3: return make<N, 3>();
    default: return make<N, 4>();
  }
}

template <int N>
Stages by_n(int n, int m) {
  if constexpr (N < SALTUS_LAST_N) {
    if (n != N) return by_n<N + 1>(n, m);
  }
  return by_m<N>(m);
}

Stages SALTUS_LOOKUP([[maybe_unused]] int n, [[maybe_unused]] int m) {
  if constexpr (SALTUS_FIRST_N == 0)
    return make<0, 0>();
  else
    return by_n<SALTUS_FIRST_N>(n, m);
}

}  // namespace saltus::SALTUS_NS
