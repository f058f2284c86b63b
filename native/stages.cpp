// Instantiates the steps for the sizes SALTUS_FIRST_N .. SALTUS_LAST_N, as the lookup SALTUS_LOOKUP.
#include "stages.hpp"

namespace saltus::SALTUS_NS {

template <int N, int M, class E>
constexpr StagesOf<E> of() {
  // Runs that move each in its own way are rare where noise is coloured: sizes known at run time will do.
  constexpr bool common = sizeof(E) == sizeof(double);
  constexpr int n = common ? N : 0, m = common ? M : 0;
  return {mix<N, E>,
          propagate<N, E>,
          measure<N, M, E, true>,
          measure<N, M, E, false>,
          advance<n, m, E, false>,
          advance<n, m, E, true>};
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

Stages SALTUS_LOOKUP(int n, int m) {
#ifdef SALTUS_ANY_N
  if (n == 0) return make<0, 0>();
#endif
  return by_n<SALTUS_FIRST_N>(n, m);
}

}  // namespace saltus::SALTUS_NS
