#include "memory_readers.h"

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace intabs::bench {
namespace {

// As the compiler likes it, for any CPU.
float ReadPlain(const float* data, size_t floats) {
  float lane[64] = {};
  for (size_t i = 0; i < floats; i += 64) {
    for (int k = 0; k < 64; ++k) lane[k] += data[i + k];
  }
  float sum = 0;
  for (const float v : lane) sum += v;
  return sum;
}

#if defined(__x86_64__)
// kStreams places read at once, kAhead bytes prefetched (0: left to the hardware).
template <int kStreams, int kAhead, int kHint>
__attribute__((target("avx512f"))) float ReadAvx512(const float* data, size_t floats) {
  constexpr int kLines = 8 / kStreams;
  __m512 sum[8];
  for (auto& s : sum) s = _mm512_setzero_ps();
  const size_t part = floats / kStreams;
  for (size_t i = 0; i < part; i += 16 * kLines) {
#pragma GCC unroll 8
    for (int s = 0; s < kStreams; ++s) {
#pragma GCC unroll 8
      for (int k = 0; k < kLines; ++k) {
        const float* p = data + s * part + i + 16 * k;
        if (kAhead > 0) _mm_prefetch(reinterpret_cast<const char*>(p) + kAhead, static_cast<_mm_hint>(kHint));
        sum[s * kLines + k] = _mm512_add_ps(sum[s * kLines + k], _mm512_loadu_ps(p));
      }
    }
  }
  float lanes[16], total = 0;
  for (int k = 1; k < 8; ++k) sum[0] = _mm512_add_ps(sum[0], sum[k]);
  _mm512_storeu_ps(lanes, sum[0]);
  for (const float v : lanes) total += v;
  return total;
}
template <int kAhead>
__attribute__((target("avx2"))) float ReadAvx2(const float* data, size_t floats) {
  __m256 sum[8];
  for (auto& s : sum) s = _mm256_setzero_ps();
  for (size_t i = 0; i < floats; i += 64) {
#pragma GCC unroll 8
    for (int k = 0; k < 8; ++k) {
      const float* p = data + i + 8 * k;
      if (kAhead > 0 && k % 2 == 0) _mm_prefetch(reinterpret_cast<const char*>(p) + kAhead, _MM_HINT_T0);
      sum[k] = _mm256_add_ps(sum[k], _mm256_loadu_ps(p));
    }
  }
  float lanes[8], total = 0;
  for (int k = 1; k < 8; ++k) sum[0] = _mm256_add_ps(sum[0], sum[k]);
  _mm256_storeu_ps(lanes, sum[0]);
  for (const float v : lanes) total += v;
  return total;
}
#endif

}  // namespace

std::vector<MemoryReader> MemoryReaders() {
  std::vector<MemoryReader> out = {{"plain", &ReadPlain}};
#if defined(__x86_64__)
  if (__builtin_cpu_supports("avx2")) {
    out.push_back({"AVX2", &ReadAvx2<0>});
    out.push_back({"AVX2, prefetch 2 KiB", &ReadAvx2<2048>});
  }
  if (__builtin_cpu_supports("avx512f")) {
    out.push_back({"AVX-512", &ReadAvx512<1, 0, _MM_HINT_T0>});
    out.push_back({"AVX-512, 2 streams", &ReadAvx512<2, 0, _MM_HINT_T0>});
    out.push_back({"AVX-512, 4 streams", &ReadAvx512<4, 0, _MM_HINT_T0>});
    out.push_back({"AVX-512, prefetch 1 KiB", &ReadAvx512<1, 1024, _MM_HINT_T0>});
    out.push_back({"AVX-512, prefetch 4 KiB", &ReadAvx512<1, 4096, _MM_HINT_T0>});
    out.push_back({"AVX-512, prefetch 2 KiB, non-temporal", &ReadAvx512<1, 2048, _MM_HINT_NTA>});
    out.push_back({"AVX-512, prefetch 2 KiB, 2 streams", &ReadAvx512<2, 2048, _MM_HINT_T0>});
  }
#endif
  return out;
}

}  // namespace intabs::bench
