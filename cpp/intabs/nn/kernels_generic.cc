// Any CPU: 16 lanes as four vectors of the compiler's own, which become SSE2, NEON or scalars.
#include "intabs/nn/kernels.h"

namespace intabs {
extern const Kernels kKernelsGeneric;
namespace {
#include "intabs/nn/kernels_impl.h"

typedef float Float4 __attribute__((vector_size(16)));
typedef int32_t Int4 __attribute__((vector_size(16)));

struct Vec {
  struct F {
    Float4 v[4];
  };
  struct I {};  // no integer products
  static constexpr bool kTwoSets = false;
  static constexpr int kTileGates = 1, kTileCols = 2;

  template <class Function>
  static INTABS_INLINE F Each(Function f) {
    return {{f(0), f(1), f(2), f(3)}};
  }
  static INTABS_INLINE F Load(const void* p) {
    const Float4* v = static_cast<const Float4*>(p);
    return {{v[0], v[1], v[2], v[3]}};
  }
  static INTABS_INLINE void Store(float* p, F x) {
    for (int i = 0; i < 4; ++i) reinterpret_cast<Float4*>(p)[i] = x.v[i];
  }
  static INTABS_INLINE F Set1(float v) {
    const Float4 f = {v, v, v, v};
    return {{f, f, f, f}};
  }
  static INTABS_INLINE F Zero() { return Set1(0.0f); }
  static INTABS_INLINE F Add(F x, F y) {
    return Each([&](int i) { return x.v[i] + y.v[i]; });
  }
  static INTABS_INLINE F Sub(F x, F y) {
    return Each([&](int i) { return x.v[i] - y.v[i]; });
  }
  static INTABS_INLINE F Mul(F x, F y) {
    return Each([&](int i) { return x.v[i] * y.v[i]; });
  }
  static INTABS_INLINE F Div(F x, F y) {
    return Each([&](int i) { return x.v[i] / y.v[i]; });
  }
  static INTABS_INLINE F Fma(F x, F y, F z) {
    return Each([&](int i) { return x.v[i] * y.v[i] + z.v[i]; });
  }
  static INTABS_INLINE F Min(F x, F y) {
    return Each([&](int i) { return x.v[i] < y.v[i] ? x.v[i] : y.v[i]; });
  }
  static INTABS_INLINE F Max(F x, F y) {
    return Each([&](int i) { return x.v[i] > y.v[i] ? x.v[i] : y.v[i]; });
  }
  static INTABS_INLINE F Exponent(F t) {
    return Each([&](int i) { return (Float4)(((Int4)t.v[i] << 23) + 0x3f800000); });
  }
  static INTABS_INLINE Int4 Words(const char* p, int i) { return reinterpret_cast<const Int4*>(p)[i]; }
  static INTABS_INLINE F LowHalf(const char* p) {
    return Each([&](int i) { return (Float4)(Words(p, i) << 16); });
  }
  static INTABS_INLINE F HighHalf(const char* p) {
    return Each([&](int i) { return (Float4)(Words(p, i) & static_cast<int32_t>(0xffff0000)); });
  }
  template <int kByte>
  static INTABS_INLINE F Byte(const char* p) {
    return Each(
        [&](int i) { return __builtin_convertvector(Words(p, i) << (24 - 8 * kByte) >> 24, Float4); });
  }
  static INTABS_INLINE void Prefetch(const char* p) { __builtin_prefetch(p); }

  static constexpr bool kHasDot8 = false;
  static constexpr bool kHasDot16 = false;
};

}  // namespace
const Kernels kKernelsGeneric = Impl<Vec>::kTable;
}  // namespace intabs
