// AVX2 and FMA: 16 lanes are two registers.
#include <immintrin.h>

#include "intabs/nn/kernels.h"

namespace intabs {
extern const Kernels kKernelsAvx2;
namespace {
#include "intabs/nn/kernels_impl.h"

struct Vec {
  struct F {
    __m256 a, b;
  };
  struct I {
    __m256i a, b;
  };
  static constexpr bool kTwoSets = false;  // 8 registers of accumulators as it is
  static constexpr int kTileGates = 1, kTileCols = 6;

  static INTABS_INLINE F Load(const void* p) {
    const float* f = static_cast<const float*>(p);
    return {_mm256_load_ps(f), _mm256_load_ps(f + 8)};
  }
  static INTABS_INLINE void Store(float* p, F v) {
    _mm256_store_ps(p, v.a);
    _mm256_store_ps(p + 8, v.b);
  }
  static INTABS_INLINE F Set1(float v) { return {_mm256_set1_ps(v), _mm256_set1_ps(v)}; }
  static INTABS_INLINE F Zero() { return {_mm256_setzero_ps(), _mm256_setzero_ps()}; }
  static INTABS_INLINE F Add(F x, F y) { return {_mm256_add_ps(x.a, y.a), _mm256_add_ps(x.b, y.b)}; }
  static INTABS_INLINE F Sub(F x, F y) { return {_mm256_sub_ps(x.a, y.a), _mm256_sub_ps(x.b, y.b)}; }
  static INTABS_INLINE F Mul(F x, F y) { return {_mm256_mul_ps(x.a, y.a), _mm256_mul_ps(x.b, y.b)}; }
  static INTABS_INLINE F Div(F x, F y) { return {_mm256_div_ps(x.a, y.a), _mm256_div_ps(x.b, y.b)}; }
  static INTABS_INLINE F Fma(F x, F y, F z) {
    return {_mm256_fmadd_ps(x.a, y.a, z.a), _mm256_fmadd_ps(x.b, y.b, z.b)};
  }
  static INTABS_INLINE F Min(F x, F y) { return {_mm256_min_ps(x.a, y.a), _mm256_min_ps(x.b, y.b)}; }
  static INTABS_INLINE F Max(F x, F y) { return {_mm256_max_ps(x.a, y.a), _mm256_max_ps(x.b, y.b)}; }
  static INTABS_INLINE F Abs(F x) {
    const __m256 mask = _mm256_castsi256_ps(_mm256_set1_epi32(0x7fffffff));
    return {_mm256_and_ps(x.a, mask), _mm256_and_ps(x.b, mask)};
  }
  static INTABS_INLINE float MaxLane(F x) {
    const __m256 m = _mm256_max_ps(x.a, x.b);
    __m128 v = _mm_max_ps(_mm256_castps256_ps128(m), _mm256_extractf128_ps(m, 1));
    v = _mm_max_ps(v, _mm_movehl_ps(v, v));
    return _mm_cvtss_f32(_mm_max_ss(v, _mm_shuffle_ps(v, v, 1)));
  }
  static INTABS_INLINE __m256 Exponent8(__m256 t) {
    return _mm256_castsi256_ps(
        _mm256_add_epi32(_mm256_slli_epi32(_mm256_castps_si256(t), 23), _mm256_set1_epi32(0x3f800000)));
  }
  static INTABS_INLINE F Exponent(F t) { return {Exponent8(t.a), Exponent8(t.b)}; }
  static INTABS_INLINE I ILoad(const char* p) {
    return {_mm256_load_si256(reinterpret_cast<const __m256i*>(p)),
            _mm256_load_si256(reinterpret_cast<const __m256i*>(p + 32))};
  }
  static INTABS_INLINE F LowHalf(const char* p) {
    const I v = ILoad(p);
    return {_mm256_castsi256_ps(_mm256_slli_epi32(v.a, 16)), _mm256_castsi256_ps(_mm256_slli_epi32(v.b, 16))};
  }
  static INTABS_INLINE F HighHalf(const char* p) {
    const I v = ILoad(p);
    const __m256i mask = _mm256_set1_epi32(static_cast<int>(0xffff0000));
    return {_mm256_castsi256_ps(_mm256_and_si256(v.a, mask)),
            _mm256_castsi256_ps(_mm256_and_si256(v.b, mask))};
  }
  static INTABS_INLINE void Prefetch(const char* p) { _mm_prefetch(p, _MM_HINT_T0); }

  static INTABS_INLINE I IZero() { return {_mm256_setzero_si256(), _mm256_setzero_si256()}; }
  static INTABS_INLINE I ISet1(uint32_t v) {
    return {_mm256_set1_epi32(static_cast<int>(v)), _mm256_set1_epi32(static_cast<int>(v))};
  }
  // As in kernels_avx512.cc.
  static constexpr bool kHasDot8 = true;
  static constexpr int kMaxDotRows = 128;
  static INTABS_INLINE void Quantise(F x, uint32_t* a, uint32_t* b) {
    alignas(32) int32_t v[16];
    _mm256_store_si256(reinterpret_cast<__m256i*>(v), _mm256_cvtps_epi32(x.a));
    _mm256_store_si256(reinterpret_cast<__m256i*>(v + 8), _mm256_cvtps_epi32(x.b));
    for (int i = 0; i < 4; ++i) {
      a[i] = (v[4 * i] & 0xffff) | static_cast<uint32_t>(v[4 * i + 2]) << 16;
      b[i] = (v[4 * i + 1] & 0xffff) | static_cast<uint32_t>(v[4 * i + 3]) << 16;
    }
  }
  // One accumulator: two would not fit the registers.
  static INTABS_INLINE __m256i Dot8Half(__m256i v, __m256i x0, __m256i x1, __m256i acc) {
    const __m256i even = _mm256_srai_epi16(_mm256_slli_epi16(v, 8), 8), odd = _mm256_srai_epi16(v, 8);
    return _mm256_add_epi32(acc, _mm256_add_epi32(_mm256_madd_epi16(even, x0), _mm256_madd_epi16(odd, x1)));
  }
  static INTABS_INLINE void Dot8(const char* w, I x0, I x1, I*, I* low) {
    const I v = ILoad(w);
    low->a = Dot8Half(v.a, x0.a, x1.a, low->a);
    low->b = Dot8Half(v.b, x0.b, x1.b, low->b);
  }
  static INTABS_INLINE F FromDot8(I, I low, const char*, bool) {
    return {_mm256_cvtepi32_ps(low.a), _mm256_cvtepi32_ps(low.b)};
  }
  static constexpr bool kHasDot16 = false;
};

}  // namespace
const Kernels kKernelsAvx2 = Impl<Vec>::kTable;
}  // namespace intabs
