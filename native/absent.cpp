// Instruction sets this build has no unit for.
#include "kernel.hpp"

namespace saltus {
#ifndef SALTUS_AVX2
const Kernel* const kAvx2 = nullptr;
#endif
#ifndef SALTUS_AVX512
const Kernel* const kAvx512 = nullptr;
#endif
}  // namespace saltus
