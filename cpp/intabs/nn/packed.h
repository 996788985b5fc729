// Weights in the layout of kernels.h, owned. Packing throws or allocates; cell() is real-time safe.
#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

#include "intabs/nn/kernels.h"
#include "intabs/nn/weights.h"

namespace intabs {

// Floats in cache lines of their own: 64-byte aligned, zero at first, copyable.
class AlignedFloats {
 public:
  void resize(size_t n) { lines_.resize((n + 15) / 16); }  // new ones are zero
  size_t size() const { return 16 * lines_.size(); }
  void SetZero() noexcept { std::fill(lines_.begin(), lines_.end(), Line{}); }
  float* data() { return reinterpret_cast<float*>(lines_.data()); }
  const float* data() const { return reinterpret_cast<const float*>(lines_.data()); }

 private:
  struct alignas(64) Line {
    float f[16] = {};
  };
  std::vector<Line> lines_;
};

// Cells one behind the other in one block of memory, in the order in which they are added.
class PackedCells {
 public:
  // W_ih (4 hidden x input), W_hh (4 hidden x hidden), both biases (4 hidden x 1).
  void AddLstm(const RowMatrixXf& w_ih, const RowMatrixXf& w_hh, const RowMatrixXf& b_ih,
               const RowMatrixXf& b_hh, WeightFormat format);
  // y = W x + b for kernels' input_gates; always fp32.
  void AddLinear(const RowMatrixXf& w, const RowMatrixXf& b);

  int size() const { return static_cast<int>(cells_.size()); }
  size_t bytes() const { return memory_.size() * sizeof(float); }
  Cell cell(int i) const noexcept;

 private:
  char* Add(const Cell& cell);
  size_t bytes(const Cell& cell) const;

  std::vector<Cell> cells_;  // without pointers, so that copies do not point elsewhere
  std::vector<size_t> offsets_;
  AlignedFloats memory_;
};

}  // namespace intabs
