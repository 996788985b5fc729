// AVX-512 with VNNI (int8 products) and BF16 (bf16 products).
#include <immintrin.h>

#include "intabs/nn/kernels.h"

namespace intabs {
extern const Kernels kKernelsAvx512Vnni;
namespace {
#include "intabs/nn/kernels_impl.h"
#include "intabs/nn/kernels_impl_avx512.h"

struct Vec : Avx512 {
  // 16 bit inputs as unsigned bytes, high and low: vpdpbusd takes unsigned times signed.
  static constexpr bool kHasDot8 = true;
  static constexpr int kMaxDotRows = 16384;  // 4 * 16384 * 255 * 128 < 2^31
  static INTABS_INLINE void Quantise(F x, uint32_t* a, uint32_t* b) {
    const I v = _mm512_add_epi32(_mm512_cvtps_epi32(x), _mm512_set1_epi32(32768));
    _mm_store_si128(reinterpret_cast<__m128i*>(a), _mm512_cvtepi32_epi8(_mm512_srli_epi32(v, 8)));
    _mm_store_si128(reinterpret_cast<__m128i*>(b), _mm512_cvtepi32_epi8(v));
  }
  static INTABS_INLINE void Dot8(const char* w, I x0, I x1, I* high, I* low) {
    const I v = _mm512_load_si512(w);
    *high = _mm512_dpbusd_epi32(*high, x0, v);
    *low = _mm512_dpbusd_epi32(*low, x1, v);
  }
  // 256 (high - 128 sum) + low: the offset of 32768 taken back, once.
  static INTABS_INLINE F FromDot8(I high, I low, const char* sums, bool first) {
    if (first) high = _mm512_sub_epi32(high, _mm512_load_si512(sums));
    return _mm512_fmadd_ps(_mm512_cvtepi32_ps(high), _mm512_set1_ps(256.0f), _mm512_cvtepi32_ps(low));
  }

  static constexpr bool kHasDot16 = true;
  static INTABS_INLINE void ToPairs(const float* x, char* out) {
    const __m256bh v = _mm512_cvtneps_pbh(_mm512_load_ps(x));
    __builtin_memcpy(out, &v, 32);
  }
  static INTABS_INLINE F Dot16(const char* w, I x, F acc) {
    const I v = _mm512_load_si512(w);
    __m512bh wb, xb;
    __builtin_memcpy(&wb, &v, 64);
    __builtin_memcpy(&xb, &x, 64);
    return _mm512_dpbf16_ps(acc, wb, xb);
  }
};

}  // namespace
const Kernels kKernelsAvx512Vnni = Impl<Vec>::kTable;
}  // namespace intabs
