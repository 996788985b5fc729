// The narrow interface between the networks and the instruction sets: one packed layout of weights, one table
// of functions an instruction set, chosen at run time. Everything here but the packing is real-time safe.
//
// Packed layout of one direction of one LSTM layer ("cell"), the same for every instruction set. Units go in
// panels of 16, padded with zeros. A matrix is stored panel by panel, each a sequence of rows of 256 bytes; a
// row holds, for gates i, f, g, o and the panel's 16 units, one 4-byte word each: one fp32 weight, two bf16
// weights of inputs k, k+1 (low half first), or four int8 weights of inputs k .. k+3. A vector over the gates
// has one such row (fp32 or int32) a panel.
//
//   cell:  bias
//          [8 bit only: scale of W_hh, scale of W_ih, 128 * sum of W_hh over a row, of W_ih (int32)]
//          W_hh, W_ih
//
// Nothing lies between, nor between one cell and the next: a step is one stream through memory.
// A linear map is a cell without W_hh whose "gates" are 64 consecutive outputs.
#pragma once

#include <cstddef>
#include <cstdint>

namespace intabs {

enum class WeightFormat : uint8_t {
  kFp32,
  k16,  // bf16
  k8,   // int8, one scale a row of W_ih and of W_hh
};

enum class Isa : uint8_t { kGeneric, kAvx2, kAvx512, kAvx512Vnni };  // the last: with VNNI and BF16
inline constexpr Isa kAllIsas[] = {Isa::kGeneric, Isa::kAvx2, Isa::kAvx512, Isa::kAvx512Vnni};

inline constexpr int kPanel = 16;               // units
inline constexpr int kPanelGates = 4 * kPanel;  // values in a row
inline constexpr int kRowBytes = 4 * kPanelGates;

// Internal linkage, and plain data below: the files compiled for one instruction set each must not share
// functions.
static constexpr int RoundUp(int n, int to) { return (n + to - 1) / to * to; }

struct Cell {
  WeightFormat format = WeightFormat::kFp32;
  int input = 0;
  int hidden = 0;  // 0: a linear map
  int panels = 0;
  int h_rows = 0, x_rows = 0;  // of a panel of W_hh, of W_ih
  // 64-byte aligned
  const char* bias = nullptr;
  const char *h_scale = nullptr, *x_scale = nullptr, *h_sums = nullptr, *x_sums = nullptr;  // 8 bit
  const char *w_hh = nullptr, *w_ih = nullptr;
};

// Largest errors of the activations, in every instruction set, against double.
inline constexpr double kExpMaxUlp =
    1.0;  // also of denormal results; overflow to infinity as rounding has it
inline constexpr double kTanhMaxUlp = 2.6;
inline constexpr double kSigmoidMaxError = 1.0e-7;  // absolute

// Vectors are float, 64-byte aligned, and readable and finite up to the next multiple of 16 beyond their
// length; matrices of n columns hold one column after the other, `ld` floats apart (a multiple of 16).
struct Kernels {
  // Bytes of scratch memory that the functions below need for `n` columns of at most `length` values.
  size_t (*scratch_bytes)(int length, int n);

  // One column, both products: h_new, c <- cell(x, h, c). h_new must not be h. `gates`: panels * 64 floats of
  // room.
  void (*step)(const Cell&, const float* x, const float* h, float* h_new, float* c, float* gates,
               void* scratch) noexcept;
  // gates[j] <- W_ih X[j] + b for n columns; a column of gates is panels * 64 floats, panel by panel.
  void (*input_gates)(const Cell&, const float* X, ptrdiff_t ld, int n, float* gates, void* scratch) noexcept;
  // One column whose input products are there: h_new, c <- cell(gates, h, c).
  void (*step_from_gates)(const Cell&, const float* gates, const float* h, float* h_new, float* c,
                          void* scratch) noexcept;
  // n columns at once. `gates`: n * 64 floats of room.
  void (*batch)(const Cell&, const float* X, ptrdiff_t ldx, const float* H, float* H_new, float* C,
                ptrdiff_t ldh, int n, float* gates, void* scratch) noexcept;

  // y[i] = f(x[i]), any length and alignment, y may be x. Whole range of float; NaN gives NaN.
  void (*exp)(const float* x, float* y, int n) noexcept;
  void (*tanh)(const float* x, float* y, int n) noexcept;
  void (*sigmoid)(const float* x, float* y, int n) noexcept;
};

const char* Name(Isa isa);
bool IsSupported(Isa isa);  // by this CPU and this build
Isa BestIsa();
const Kernels& KernelsFor(Isa isa);  // must be supported

}  // namespace intabs
