// The kernels, written once over a 16-lane vector type V. Each kernels_<isa>.cc includes this file inside an
// anonymous namespace, after its V, and is compiled with flags of its own: so nothing here may use anything
// from a header that another file could share (an inline function compiled for AVX-512 must not be the one
// that the linker keeps).
//
// V has: F (16 floats), Load, Store, Set1, Zero, Add, Sub, Mul, Div, Fma (a b + c), Min, Max (the second
// argument where one is NaN), Abs, MaxLane, Exponent (float whose bits are those of its argument shifted left
// by 23, plus 1.0's), LowHalf, HighHalf (of 16 words of two bf16, as floats), Prefetch, kTileGates, kTileCols
// (what fits the registers). For 8 bit: kHasDot8; I (16 int32), IZero, ISet1, kMaxDotRows, Quantise, Dot8,
// FromDot8. For bf16 products: kHasDot16, ToPairs, Dot16.

#define INTABS_UNROLL _Pragma("GCC unroll 16")
#define INTABS_INLINE inline __attribute__((always_inline))

template <class V>
struct Impl {
  using F = typename V::F;
  using I = typename V::I;

  // --------------------------------------------------------------------------------------------------
  // activations exp(r) - 1 on |r| <= ln(2)/2, and n, t with x = n ln 2 + r; 2^n = V::Exponent(t). Cody-Waite
  // reduction and the polynomial of Cephes' expf.
  static INTABS_INLINE F ExpM1Reduced(F x, F* n, F* t) {
    const F magic = V::Set1(12582912.0f);  // 1.5 * 2^23: adding it rounds to a whole number, in the low bits
    *t = V::Fma(x, V::Set1(1.44269504088896341f), magic);
    *n = V::Sub(*t, magic);
    F r = V::Fma(*n, V::Set1(-0.693359375f), x);
    r = V::Fma(*n, V::Set1(2.12194440e-4f), r);
    F p = V::Set1(1.9875691500e-4f);
    p = V::Fma(p, r, V::Set1(1.3981999507e-3f));
    p = V::Fma(p, r, V::Set1(8.3334519073e-3f));
    p = V::Fma(p, r, V::Set1(4.1665795894e-2f));
    p = V::Fma(p, r, V::Set1(1.6666665459e-1f));
    p = V::Fma(p, r, V::Set1(5.0000001201e-1f));
    return V::Fma(V::Mul(p, r), r, r);
  }
  // NaN passes: Min and Max return their second argument then.
  static INTABS_INLINE F Clamp(F x, float low, float high) {
    return V::Max(V::Set1(low), V::Min(V::Set1(high), x));
  }

  // Over the whole range: overflows to infinity, underflows gradually (2^n in two factors).
  static INTABS_INLINE F Exp(F x) {
    F n, t;
    const F e = V::Add(ExpM1Reduced(Clamp(x, -105.0f, 90.0f), &n, &t), V::Set1(1.0f));
    const F magic = V::Set1(12582912.0f);
    const F t1 = V::Fma(n, V::Set1(0.5f), magic);
    const F n2 = V::Sub(n, V::Sub(t1, magic));
    return V::Mul(V::Mul(e, V::Exponent(t1)), V::Exponent(V::Add(n2, magic)));
  }
  static INTABS_INLINE F Sigmoid(F x) {  // 1 / (1 + exp(-x))
    F n, t;
    const F p = ExpM1Reduced(V::Sub(V::Zero(), Clamp(x, -87.5f, 87.5f)), &n, &t);
    const F s = V::Exponent(t);
    return V::Div(V::Set1(1.0f), V::Add(V::Fma(p, s, s), V::Set1(1.0f)));
  }
  static INTABS_INLINE F Tanh(F x) {  // E / (E + 2), E = exp(2x) - 1 without cancellation
    F n, t;
    const F p = ExpM1Reduced(Clamp(V::Add(x, x), -20.0f, 20.0f), &n, &t);
    const F s = V::Exponent(t);
    const F e = V::Fma(p, s, V::Sub(s, V::Set1(1.0f)));
    return V::Div(e, V::Add(e, V::Set1(2.0f)));
  }
  // exp(-x), and exp(2x) - 1, kept below e^29: products of three of them stay finite, and what is cut off is
  // 3e-13.
  static INTABS_INLINE F ExpMinus(F x) {
    F n, t;
    const F p = ExpM1Reduced(V::Sub(V::Zero(), Clamp(x, -29.0f, 29.0f)), &n, &t);
    const F s = V::Exponent(t);
    return V::Fma(p, s, s);
  }
  static INTABS_INLINE F ExpM1Twice(F x) {
    F n, t;
    const F p = ExpM1Reduced(Clamp(V::Add(x, x), -29.0f, 29.0f), &n, &t);
    const F s = V::Exponent(t);
    return V::Fma(p, s, V::Sub(s, V::Set1(1.0f)));
  }
  // c' = sigmoid(f) c + sigmoid(i) tanh(g), h' = sigmoid(o) tanh(c'), each over its common denominator: two
  // divisions instead of five.
  static INTABS_INLINE void Activate(const F* g, float* c, float* h_new) {
    const F one = V::Set1(1.0f), two = V::Set1(2.0f);
    const F i = V::Add(ExpMinus(g[0]), one), f = V::Add(ExpMinus(g[1]), one);  // sigmoid = 1 / these
    const F e = ExpM1Twice(g[2]);                                              // tanh = e / (e + 2)
    const F i_e2 = V::Mul(i, V::Add(e, two));
    const F c_new = V::Div(V::Fma(V::Load(c), i_e2, V::Mul(e, f)), V::Mul(f, i_e2));
    V::Store(c, c_new);
    const F ec = ExpM1Twice(c_new);
    V::Store(h_new, V::Div(ec, V::Mul(V::Add(ExpMinus(g[3]), one), V::Add(ec, two))));
  }

  template <F (*Function)(F)>
  static void Map(const float* x, float* y, int n) noexcept {
    alignas(64) float v[16] = {};
    int i = 0;
    for (; i + 16 <= n; i += 16) {
      __builtin_memcpy(v, x + i, 64);
      V::Store(v, Function(V::Load(v)));
      __builtin_memcpy(y + i, v, 64);
    }
    for (int k = i; k < n; ++k) v[k - i] = x[k];
    V::Store(v, Function(V::Load(v)));
    for (int k = i; k < n; ++k) y[k] = v[k - i];
  }

  // ----------------------------------------------------------------------------- one column: a stream of
  // weights

  // Ahead of the loads, in bytes; crosses panels and layers, so that memory stays busy while gates are
  // computed.
  static constexpr int kAhead = 2048;
  template <bool kFetch>
  static INTABS_INLINE void Fetch(const char* p) {
    if constexpr (kFetch) V::Prefetch(p + kAhead);
  }

  // acc[0..3] + more[0..3] += W x.
  template <bool kFetch>
  static INTABS_INLINE void Fp32Rows(const char* w, const float* x, int n, F* acc, F* more) {
    F* second = V::kTwoSets ? more : acc;
    int k = 0;
    for (; k + 2 <= n; k += 2, w += 512) {
      const F x0 = V::Set1(x[k]), x1 = V::Set1(x[k + 1]);
      INTABS_UNROLL for (int g = 0; g < 4; ++g) {
        Fetch<kFetch>(w + 64 * g);
        acc[g] = V::Fma(V::Load(w + 64 * g), x0, acc[g]);
      }
      INTABS_UNROLL for (int g = 0; g < 4; ++g) {
        Fetch<kFetch>(w + 256 + 64 * g);
        second[g] = V::Fma(V::Load(w + 256 + 64 * g), x1, second[g]);
      }
    }
    if (k < n) {
      INTABS_UNROLL for (int g = 0; g < 4; ++g) acc[g] = V::Fma(V::Load(w + 64 * g), V::Set1(x[k]), acc[g]);
    }
  }
  template <bool kFetch>
  static INTABS_INLINE void Bf16Rows(const char* w, const float* x, int n, F* acc, F* more) {
    F* second = V::kTwoSets ? more : acc;
    for (int k = 0; k < n; k += 2, w += 256) {
      const F x0 = V::Set1(x[k]), x1 = V::Set1(x[k + 1]);
      INTABS_UNROLL for (int g = 0; g < 4; ++g) {
        Fetch<kFetch>(w + 64 * g);
        acc[g] = V::Fma(V::LowHalf(w + 64 * g), x0, acc[g]);
        second[g] = V::Fma(V::HighHalf(w + 64 * g), x1, second[g]);
      }
    }
  }
  // g[0..3] += scale * (W x), x as two arrays of words from V::Quantise. `sums`: 128 * the sum of each row of
  // W.
  template <bool kFetch>
  static INTABS_INLINE void Int8Rows(const char* w, const uint32_t* a, const uint32_t* b, int rows,
                                     float x_scale, const char* scale, const char* sums, F* g) {
    for (int i = 0; i < rows;) {
      I high[4], low[4];
      INTABS_UNROLL for (int k = 0; k < 4; ++k) high[k] = low[k] = V::IZero();
      const int end = i + V::kMaxDotRows < rows ? i + V::kMaxDotRows : rows;
      const bool first = i == 0;
      for (; i < end; ++i, w += 256) {
        const I x0 = V::ISet1(a[i]), x1 = V::ISet1(b[i]);
        INTABS_UNROLL for (int k = 0; k < 4; ++k) {
          Fetch<kFetch>(w + 64 * k);
          V::Dot8(w + 64 * k, x0, x1, &high[k], &low[k]);
        }
      }
      INTABS_UNROLL for (int k = 0; k < 4; ++k) {
        const F dot = V::FromDot8(high[k], low[k], sums + 64 * k, first);
        g[k] = V::Fma(V::Mul(dot, V::Set1(x_scale)), V::Load(scale + 64 * k), g[k]);
      }
    }
  }
  // The same without integer products: fp32 inputs, weights widened to float.
  static INTABS_INLINE void Int8RowsFloat(const char* w, const float* x, int n, const char* scale, F* g) {
    F acc[4];
    INTABS_UNROLL for (int i = 0; i < 4; ++i) acc[i] = V::Zero();
    for (int k = 0; k < n; k += 4, w += 256) {
      INTABS_UNROLL for (int i = 0; i < 4; ++i) {
        acc[i] = V::Fma(V::template Byte<0>(w + 64 * i), V::Set1(x[k]), acc[i]);
        acc[i] = V::Fma(V::template Byte<1>(w + 64 * i), V::Set1(x[k + 1]), acc[i]);
        acc[i] = V::Fma(V::template Byte<2>(w + 64 * i), V::Set1(x[k + 2]), acc[i]);
        acc[i] = V::Fma(V::template Byte<3>(w + 64 * i), V::Set1(x[k + 3]), acc[i]);
      }
    }
    INTABS_UNROLL for (int i = 0; i < 4; ++i) g[i] = V::Fma(acc[i], V::Load(scale + 64 * i), g[i]);
  }

  // x in the words that int8 products take: two arrays, and the scale that undoes it. 0 for x = 0.
  static INTABS_INLINE float Quantise(const float* x, int n, uint32_t* a, uint32_t* b) {
    F largest = V::Zero();
    for (int k = 0; k < n; k += 16) largest = V::Max(largest, V::Abs(V::Load(x + k)));
    const float top = V::MaxLane(largest);
    const F scale = V::Set1(top > 1e-30f ? 32767.0f / top : 0.0f);
    for (int k = 0; k < n; k += 16) V::Quantise(V::Mul(V::Load(x + k), scale), a + k / 4, b + k / 4);
    return top * (1.0f / 32767.0f);
  }

  // A column as the products of a format take it.
  struct Column {
    const float* x = nullptr;
    const uint32_t *a = nullptr, *b = nullptr;  // of Quantise
    float scale = 0;
  };
  static INTABS_INLINE Column PrepareOne(WeightFormat format, const float* x, int n, void* scratch) {
    Column out{x};
    if constexpr (V::kHasDot8) {
      if (format == WeightFormat::k8) {
        uint32_t* a = static_cast<uint32_t*>(scratch);
        uint32_t* b = a + RoundUp(n, 16) / 4;
        out.scale = Quantise(x, n, a, b);
        out.a = a, out.b = b;
      }
    }
    return out;
  }
  // acc[0..3] += one panel of W times x.
  template <bool kFetch>
  static INTABS_INLINE void PanelTimes(WeightFormat format, const char* w, const Column& x, int n, int rows,
                                       const char* scale, const char* sums, F* acc) {
    if (format == WeightFormat::k8) {
      if constexpr (V::kHasDot8) {
        Int8Rows<kFetch>(w, x.a, x.b, rows, x.scale, scale, sums, acc);
      } else {
        Int8RowsFloat(w, x.x, n, scale, acc);
      }
      return;
    }
    F more[4];
    INTABS_UNROLL for (int g = 0; g < 4; ++g) more[g] = V::Zero();
    if (format == WeightFormat::kFp32) {
      Fp32Rows<kFetch>(w, x.x, n, acc, more);
    } else {
      Bf16Rows<kFetch>(w, x.x, n, acc, more);
    }
    if (V::kTwoSets) {
      INTABS_UNROLL for (int g = 0; g < 4; ++g) acc[g] = V::Add(acc[g], more[g]);
    }
  }

  // W_hh first, for all panels: it does not wait for the layer below, whose last gates are still being
  // computed.
  static void Step(const Cell& cell, const float* x, const float* h, float* h_new, float* c, float* gates,
                   void* scratch) noexcept {
    const size_t h_panel = static_cast<size_t>(cell.h_rows) * 256,
                 x_panel = static_cast<size_t>(cell.x_rows) * 256;
    const Column hc = PrepareOne(cell.format, h, cell.hidden, scratch);
    for (int p = 0; p < cell.panels; ++p) {
      F acc[4];
      INTABS_UNROLL for (int g = 0; g < 4; ++g) acc[g] = V::Load(cell.bias + 256 * p + 64 * g);
      PanelTimes<true>(cell.format, cell.w_hh + p * h_panel, hc, cell.hidden, cell.h_rows,
                       cell.h_scale + 256 * p, cell.h_sums + 256 * p, acc);
      INTABS_UNROLL for (int g = 0; g < 4; ++g) V::Store(gates + 64 * p + 16 * g, acc[g]);
    }
    const Column xc = PrepareOne(cell.format, x, cell.input, scratch);
    for (int p = 0; p < cell.panels; ++p) {
      F acc[4];
      INTABS_UNROLL for (int g = 0; g < 4; ++g) acc[g] = V::Load(gates + 64 * p + 16 * g);
      PanelTimes<true>(cell.format, cell.w_ih + p * x_panel, xc, cell.input, cell.x_rows,
                       cell.x_scale + 256 * p, cell.x_sums + 256 * p, acc);
      Activate(acc, c + 16 * p, h_new + 16 * p);
    }
  }
  static void StepFromGates(const Cell& cell, const float* gates, const float* h, float* h_new, float* c,
                            void* scratch) noexcept {
    const size_t h_panel = static_cast<size_t>(cell.h_rows) * 256;
    const Column hc = PrepareOne(cell.format, h, cell.hidden, scratch);
    for (int p = 0; p < cell.panels; ++p) {
      F acc[4];
      INTABS_UNROLL for (int g = 0; g < 4; ++g) acc[g] = V::Zero();
      PanelTimes<false>(cell.format, cell.w_hh + p * h_panel, hc, cell.hidden, cell.h_rows,
                        cell.h_scale + 256 * p, cell.h_sums + 256 * p, acc);
      // Last, so that nobody waits for them: they come from far away.
      INTABS_UNROLL for (int g = 0; g < 4; ++g) acc[g] = V::Add(acc[g], V::Load(gates + 64 * p + 16 * g));
      Activate(acc, c + 16 * p, h_new + 16 * p);
    }
  }

  // ---------------------------------------------------------------- many columns: register tiles of G += W X
  // G: 64 floats a column (the gates of one panel), `ldg` floats apart.

  // Columns as a part's product takes them, made once for all panels.
  struct Columns {
    const char* a = nullptr;  // fp32 values, bf16 pairs, or the first words of V::Quantise
    const char* b = nullptr;  // the second words
    const float* scale = nullptr;
    ptrdiff_t ld = 0;  // bytes from column to column
  };
  static size_t ScratchBytes(int length, int n) {
    // Two parts (h and x) of two arrays of words and a scale a column.
    return 2 * static_cast<size_t>(n) * (2 * static_cast<size_t>(RoundUp(length, 16)) + 64) + 128;
  }
  static Columns Prepare(WeightFormat format, const float* X, ptrdiff_t ld, int length, int n,
                         char** scratch) {
    Columns out{reinterpret_cast<const char*>(X), nullptr, nullptr, 4 * ld};
    const int padded = RoundUp(length, 16);
    if constexpr (V::kHasDot16) {
      if (format == WeightFormat::k16) {
        char* a = *scratch;
        out.ld = 2 * padded;
        for (int j = 0; j < n; ++j) {
          for (int k = 0; k < padded; k += 16) V::ToPairs(X + j * ld + k, a + j * out.ld + 2 * k);
        }
        out.a = a;
        *scratch = a + n * out.ld;
      }
    }
    if constexpr (V::kHasDot8) {
      if (format == WeightFormat::k8) {
        out.ld = padded;
        char *a = *scratch, *b = a + n * out.ld;
        float* scale = reinterpret_cast<float*>(b + n * out.ld);
        for (int j = 0; j < n; ++j) {
          scale[j] = Quantise(X + j * ld, length, reinterpret_cast<uint32_t*>(a + j * out.ld),
                              reinterpret_cast<uint32_t*>(b + j * out.ld));
        }
        out.a = a, out.b = b, out.scale = scale;
        *scratch = reinterpret_cast<char*>(scale + RoundUp(n, 16));
      }
    }
    return out;
  }

  template <int kGates, int kCols>
  static INTABS_INLINE void TileFp32(const char* w, int n, const char* x, ptrdiff_t ld, float* G,
                                     ptrdiff_t ldg) {
    F acc[kCols][kGates];
    INTABS_UNROLL for (int j = 0; j < kCols; ++j) INTABS_UNROLL for (int g = 0; g < kGates; ++g) acc[j][g] =
        V::Load(G + j * ldg + 16 * g);
    for (int k = 0; k < n; ++k, w += 256) {
      F v[kGates];
      INTABS_UNROLL for (int g = 0; g < kGates; ++g) v[g] = V::Load(w + 64 * g);
      INTABS_UNROLL for (int j = 0; j < kCols; ++j) {
        const F b = V::Set1(reinterpret_cast<const float*>(x + j * ld)[k]);
        INTABS_UNROLL for (int g = 0; g < kGates; ++g) acc[j][g] = V::Fma(v[g], b, acc[j][g]);
      }
    }
    INTABS_UNROLL for (int j = 0; j < kCols; ++j) INTABS_UNROLL for (int g = 0; g < kGates; ++g)
        V::Store(G + j * ldg + 16 * g, acc[j][g]);
  }
  template <int kGates, int kCols>
  static INTABS_INLINE void TileBf16(const char* w, int n, const char* x, ptrdiff_t ld, float* G,
                                     ptrdiff_t ldg) {
    F acc[kCols][kGates];
    INTABS_UNROLL for (int j = 0; j < kCols; ++j) INTABS_UNROLL for (int g = 0; g < kGates; ++g) acc[j][g] =
        V::Load(G + j * ldg + 16 * g);
    for (int k = 0; k < n; k += 2, w += 256) {
      if constexpr (V::kHasDot16) {
        INTABS_UNROLL for (int j = 0; j < kCols; ++j) {
          const I b = V::ISet1(reinterpret_cast<const uint32_t*>(x + j * ld)[k / 2]);
          INTABS_UNROLL for (int g = 0; g < kGates; ++g) acc[j][g] = V::Dot16(w + 64 * g, b, acc[j][g]);
        }
      } else {
        F low[kGates], high[kGates];
        INTABS_UNROLL for (int g = 0; g < kGates; ++g) low[g] = V::LowHalf(w + 64 * g),
                                                       high[g] = V::HighHalf(w + 64 * g);
        INTABS_UNROLL for (int j = 0; j < kCols; ++j) {
          const float* xj = reinterpret_cast<const float*>(x + j * ld);
          const F b0 = V::Set1(xj[k]), b1 = V::Set1(xj[k + 1]);
          INTABS_UNROLL for (int g = 0; g < kGates; ++g) {
            acc[j][g] = V::Fma(high[g], b1, V::Fma(low[g], b0, acc[j][g]));
          }
        }
      }
    }
    INTABS_UNROLL for (int j = 0; j < kCols; ++j) INTABS_UNROLL for (int g = 0; g < kGates; ++g)
        V::Store(G + j * ldg + 16 * g, acc[j][g]);
  }
  template <bool kBf16, int kGates, int kCols>
  static INTABS_INLINE void Tile(const char* w, int length, const char* x, ptrdiff_t ld, float* G,
                                 ptrdiff_t ldg) {
    if constexpr (kBf16) {
      TileBf16<kGates, kCols>(w, length, x, ld, G, ldg);
    } else {
      TileFp32<kGates, kCols>(w, length, x, ld, G, ldg);
    }
  }
  // The last n < kCols columns at once.
  template <bool kBf16, int kGates, int kCols>
  static INTABS_INLINE void Rest(const char* w, int length, const char* x, ptrdiff_t ld, int n, float* G,
                                 ptrdiff_t ldg) {
    if constexpr (kCols > 1) {
      if (n == kCols - 1) {
        Tile<kBf16, kGates, kCols - 1>(w, length, x, ld, G, ldg);
      } else {
        Rest<kBf16, kGates, kCols - 1>(w, length, x, ld, n, G, ldg);
      }
    }
  }
  template <bool kBf16, int kGates, int kCols>
  static void Tiles(const char* w, int length, const Columns& x, int n, float* G, ptrdiff_t ldg) {
    for (int g = 0; g < 4; g += kGates) {
      int j = 0;
      for (; j + kCols <= n; j += kCols) {
        Tile<kBf16, kGates, kCols>(w + 64 * g, length, x.a + j * x.ld, x.ld, G + j * ldg + 16 * g, ldg);
      }
      if (j < n) {
        Rest<kBf16, kGates, kCols>(w + 64 * g, length, x.a + j * x.ld, x.ld, n - j, G + j * ldg + 16 * g,
                                   ldg);
      }
    }
  }
  static void Part(WeightFormat format, const char* w, int length, int rows, const Columns& x, int n,
                   const char* scale, const char* sums, float* G, ptrdiff_t ldg) {
    if (format == WeightFormat::kFp32) {
      Tiles<false, V::kTileGates, V::kTileCols>(w, length, x, n, G, ldg);
    } else if (format == WeightFormat::k16) {
      Tiles<true, V::kTileGates, V::kTileCols>(w, length, x, n, G, ldg);
    } else {
      for (int j = 0; j < n; ++j) {
        F acc[4];
        INTABS_UNROLL for (int g = 0; g < 4; ++g) acc[g] = V::Load(G + j * ldg + 16 * g);
        const char *a = x.a + j * x.ld, *b = x.b + j * x.ld;
        if constexpr (V::kHasDot8) {
          Int8Rows<false>(w, reinterpret_cast<const uint32_t*>(a), reinterpret_cast<const uint32_t*>(b), rows,
                          x.scale[j], scale, sums, acc);
        } else {
          Int8RowsFloat(w, reinterpret_cast<const float*>(a), length, scale, acc);
        }
        INTABS_UNROLL for (int g = 0; g < 4; ++g) V::Store(G + j * ldg + 16 * g, acc[g]);
      }
    }
  }
  static INTABS_INLINE void Fill(const char* row, int n, float* G, ptrdiff_t ldg) {
    F v[4];
    INTABS_UNROLL for (int g = 0; g < 4; ++g) v[g] = V::Load(row + 64 * g);
    for (int j = 0; j < n; ++j) {
      INTABS_UNROLL for (int g = 0; g < 4; ++g) V::Store(G + j * ldg + 16 * g, v[g]);
    }
  }

  static void InputGates(const Cell& cell, const float* X, ptrdiff_t ld, int n, float* gates,
                         void* scratch) noexcept {
    const size_t x_panel = static_cast<size_t>(cell.x_rows) * 256;
    char* room = static_cast<char*>(scratch);
    const Columns x = Prepare(cell.format, X, ld, cell.input, n, &room);
    const ptrdiff_t ldg = 64 * static_cast<ptrdiff_t>(cell.panels);
    for (int p = 0; p < cell.panels; ++p, gates += 64) {
      Fill(cell.bias + 256 * p, n, gates, ldg);
      Part(cell.format, cell.w_ih + p * x_panel, cell.input, cell.x_rows, x, n, cell.x_scale + 256 * p,
           cell.x_sums + 256 * p, gates, ldg);
    }
  }
  static void Batch(const Cell& cell, const float* X, ptrdiff_t ldx, const float* H, float* H_new, float* C,
                    ptrdiff_t ldh, int n, float* gates, void* scratch) noexcept {
    const size_t h_panel = static_cast<size_t>(cell.h_rows) * 256,
                 x_panel = static_cast<size_t>(cell.x_rows) * 256;
    char* room = static_cast<char*>(scratch);
    const Columns h = Prepare(cell.format, H, ldh, cell.hidden, n, &room);
    const Columns x = Prepare(cell.format, X, ldx, cell.input, n, &room);
    for (int p = 0; p < cell.panels; ++p, C += 16, H_new += 16) {
      Fill(cell.bias + 256 * p, n, gates, 64);
      Part(cell.format, cell.w_hh + p * h_panel, cell.hidden, cell.h_rows, h, n, cell.h_scale + 256 * p,
           cell.h_sums + 256 * p, gates, 64);
      Part(cell.format, cell.w_ih + p * x_panel, cell.input, cell.x_rows, x, n, cell.x_scale + 256 * p,
           cell.x_sums + 256 * p, gates, 64);
      for (int j = 0; j < n; ++j) {
        F g[4];
        INTABS_UNROLL for (int i = 0; i < 4; ++i) g[i] = V::Load(gates + 64 * j + 16 * i);
        Activate(g, C + j * ldh, H_new + j * ldh);
      }
    }
  }

  static constexpr Kernels kTable = {&ScratchBytes, &Step,     &InputGates, &StepFromGates,
                                     &Batch,        &Map<Exp>, &Map<Tanh>,  &Map<Sigmoid>};
};
