// AVX-512 F and BW alone.
#include <immintrin.h>

#include "intabs/nn/kernels.h"

namespace intabs {
extern const Kernels kKernelsAvx512;
namespace {
#include "intabs/nn/kernels_impl.h"
#include "intabs/nn/kernels_impl_avx512.h"

struct Vec : Avx512 {
  // 16 bit inputs as pairs (x0, x2), (x1, x3) against the even and odd bytes of a word, widened: vpmaddwd.
  static constexpr bool kHasDot8 = true;
  static constexpr int kMaxDotRows = 128;  // 4 * 128 * 32767 * 127 < 2^31
  static INTABS_INLINE void Quantise(F x, uint32_t* a, uint32_t* b) {
    alignas(64) int32_t v[16];
    _mm512_store_si512(v, _mm512_cvtps_epi32(x));
    for (int i = 0; i < 4; ++i) {
      a[i] = (v[4 * i] & 0xffff) | static_cast<uint32_t>(v[4 * i + 2]) << 16;
      b[i] = (v[4 * i + 1] & 0xffff) | static_cast<uint32_t>(v[4 * i + 3]) << 16;
    }
  }
  static INTABS_INLINE void Dot8(const char* w, I x0, I x1, I* high, I* low) {
    const I v = _mm512_load_si512(w);
    *low = _mm512_add_epi32(*low, _mm512_madd_epi16(_mm512_srai_epi16(_mm512_slli_epi16(v, 8), 8), x0));
    *high = _mm512_add_epi32(*high, _mm512_madd_epi16(_mm512_srai_epi16(v, 8), x1));
  }
  static INTABS_INLINE F FromDot8(I high, I low, const char*, bool) {
    return _mm512_cvtepi32_ps(_mm512_add_epi32(high, low));
  }
  static constexpr bool kHasDot16 = false;
};

}  // namespace
const Kernels kKernelsAvx512 = Impl<Vec>::kTable;
}  // namespace intabs
