#include "intabs/nn/kernels.h"

namespace intabs {

extern const Kernels kKernelsGeneric;
#ifdef INTABS_X86_KERNELS
extern const Kernels kKernelsAvx2, kKernelsAvx512, kKernelsAvx512Vnni;
#endif

const char* Name(Isa isa) {
  switch (isa) {
    case Isa::kGeneric:
      return "generic";
    case Isa::kAvx2:
      return "AVX2+FMA";
    case Isa::kAvx512:
      return "AVX-512";
    case Isa::kAvx512Vnni:
      return "AVX-512 VNNI/BF16";
  }
  return "?";
}

bool IsSupported(Isa isa) {
#ifdef INTABS_X86_KERNELS
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  const bool avx512 = avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq");
  switch (isa) {
    case Isa::kGeneric:
      return true;
    case Isa::kAvx2:
      return avx2;
    case Isa::kAvx512:
      return avx512;
    case Isa::kAvx512Vnni:
      return avx512 && __builtin_cpu_supports("avx512vnni") && __builtin_cpu_supports("avx512bf16");
  }
  return false;
#else
  return isa == Isa::kGeneric;
#endif
}

Isa BestIsa() {
  Isa best = Isa::kGeneric;
  for (const Isa isa : kAllIsas) {
    if (IsSupported(isa)) best = isa;
  }
  return best;
}

const Kernels& KernelsFor(Isa isa) {
#ifdef INTABS_X86_KERNELS
  switch (isa) {
    case Isa::kGeneric:
      break;
    case Isa::kAvx2:
      return kKernelsAvx2;
    case Isa::kAvx512:
      return kKernelsAvx512;
    case Isa::kAvx512Vnni:
      return kKernelsAvx512Vnni;
  }
#endif
  return kKernelsGeneric;
}

}  // namespace intabs
