// Shared by the two AVX-512 files, inside their anonymous namespaces.
struct Avx512 {
  using F = __m512;
  using I = __m512i;
  static constexpr bool kTwoSets = true;  // 4 accumulators would wait for the latency of FMA
  static constexpr int kTileGates = 4, kTileCols = 6;

  static INTABS_INLINE F Load(const void* p) { return _mm512_load_ps(p); }
  static INTABS_INLINE void Store(float* p, F v) { _mm512_store_ps(p, v); }
  static INTABS_INLINE F Set1(float v) { return _mm512_set1_ps(v); }
  static INTABS_INLINE F Zero() { return _mm512_setzero_ps(); }
  static INTABS_INLINE F Add(F a, F b) { return _mm512_add_ps(a, b); }
  static INTABS_INLINE F Sub(F a, F b) { return _mm512_sub_ps(a, b); }
  static INTABS_INLINE F Mul(F a, F b) { return _mm512_mul_ps(a, b); }
  static INTABS_INLINE F Div(F a, F b) { return _mm512_div_ps(a, b); }
  static INTABS_INLINE F Fma(F a, F b, F c) { return _mm512_fmadd_ps(a, b, c); }
  static INTABS_INLINE F Min(F a, F b) { return _mm512_min_ps(a, b); }
  static INTABS_INLINE F Max(F a, F b) { return _mm512_max_ps(a, b); }
  static INTABS_INLINE F Abs(F a) { return _mm512_abs_ps(a); }
  static INTABS_INLINE float MaxLane(F a) { return _mm512_reduce_max_ps(a); }
  static INTABS_INLINE F Exponent(F t) {
    return _mm512_castsi512_ps(
        _mm512_add_epi32(_mm512_slli_epi32(_mm512_castps_si512(t), 23), _mm512_set1_epi32(0x3f800000)));
  }
  static INTABS_INLINE F LowHalf(const char* p) {
    return _mm512_castsi512_ps(_mm512_slli_epi32(_mm512_load_si512(p), 16));
  }
  static INTABS_INLINE F HighHalf(const char* p) {
    return _mm512_castsi512_ps(
        _mm512_and_si512(_mm512_load_si512(p), _mm512_set1_epi32(static_cast<int>(0xffff0000))));
  }
  static INTABS_INLINE void Prefetch(const char* p) { _mm_prefetch(p, _MM_HINT_T0); }

  static INTABS_INLINE I IZero() { return _mm512_setzero_si512(); }
  static INTABS_INLINE I ISet1(uint32_t v) { return _mm512_set1_epi32(static_cast<int>(v)); }
};
