// Instruction sets this build has no unit for.
#include "kernel.hpp"

namespace saltus {
#ifndef SALTUS_X86
const Kernel* const kAvx2 = nullptr;
const Kernel* const kAvx512 = nullptr;
#endif
}  // namespace saltus
