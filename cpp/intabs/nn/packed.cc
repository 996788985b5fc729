#include "intabs/nn/packed.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>

namespace intabs {
namespace {

uint16_t ToBf16(float v) {  // round to nearest, ties to even
  const uint32_t bits = std::bit_cast<uint32_t>(v);
  return static_cast<uint16_t>((bits + 0x7fff + (bits >> 16 & 1)) >> 16);
}

Cell Describe(WeightFormat format, int input, int hidden, int panels) {
  const int per_word = format == WeightFormat::kFp32 ? 1 : format == WeightFormat::k16 ? 2 : 4;
  Cell c{.format = format, .input = input, .hidden = hidden, .panels = panels};
  c.h_rows = RoundUp(hidden, per_word) / per_word;
  c.x_rows = RoundUp(input, per_word) / per_word;
  return c;
}

// Row `source` of W becomes lane `lane` of a panel's rows at `out`. 8 bit: also its scale, and 128 times its
// sum.
void PackRow(const RowMatrixXf& W, int source, int lane, WeightFormat format, char* out, char* scale,
             char* sum) {
  const int n = static_cast<int>(W.cols());
  const auto at = [&](int k) { return k < n ? W(source, k) : 0.0f; };
  if (format == WeightFormat::kFp32) {
    for (int k = 0; k < n; ++k) std::memcpy(out + k * kRowBytes + 4 * lane, &W(source, k), 4);
  } else if (format == WeightFormat::k16) {
    for (int k = 0; k < n; k += 2) {
      const uint16_t pair[2] = {ToBf16(at(k)), ToBf16(at(k + 1))};
      std::memcpy(out + k / 2 * kRowBytes + 4 * lane, pair, 4);
    }
  } else {
    const float largest = W.row(source).cwiseAbs().maxCoeff();
    const float step = largest / 127.0f;
    int32_t total = 0;
    for (int k = 0; k < n; k += 4) {
      int8_t four[4];
      for (int i = 0; i < 4; ++i) {
        // Clamped: the division may round past 127, and is undone by no step at all where all are zero or
        // denormal.
        const float q = step > 0 ? std::clamp(at(k + i) / step, -127.0f, 127.0f) : 0.0f;
        four[i] = static_cast<int8_t>(std::lrint(q));
        total += four[i];
      }
      std::memcpy(out + k / 4 * kRowBytes + 4 * lane, four, 4);
    }
    total *= 128;
    std::memcpy(scale + 4 * lane, &step, 4);
    std::memcpy(sum + 4 * lane, &total, 4);
  }
}

// Vectors over the gates that a cell has.
int NumVectors(WeightFormat format) { return format == WeightFormat::k8 ? 5 : 1; }

}  // namespace

size_t PackedCells::bytes(const Cell& c) const {
  return static_cast<size_t>(c.panels) * (NumVectors(c.format) + c.h_rows + c.x_rows) * kRowBytes;
}

char* PackedCells::Add(const Cell& cell) {
  const size_t offset = memory_.size() * sizeof(float);
  memory_.resize((offset + bytes(cell)) / sizeof(float));
  cells_.push_back(cell);
  offsets_.push_back(offset);
  return reinterpret_cast<char*>(memory_.data()) + offset;
}

Cell PackedCells::cell(int i) const noexcept {
  Cell c = cells_[i];
  const char* at = reinterpret_cast<const char*>(memory_.data()) + offsets_[i];
  const auto take = [&](int rows) {
    const char* start = at;
    at += static_cast<size_t>(rows) * c.panels * kRowBytes;
    return start;
  };
  c.bias = take(1);
  c.h_scale = c.x_scale = c.h_sums = c.x_sums = c.bias;  // not read; but offsets are taken from them
  if (c.format == WeightFormat::k8) {
    c.h_scale = take(1);
    c.x_scale = take(1);
    c.h_sums = take(1);
    c.x_sums = take(1);
  }
  c.w_hh = take(c.h_rows);
  c.w_ih = take(c.x_rows);
  return c;
}

void PackedCells::AddLstm(const RowMatrixXf& w_ih, const RowMatrixXf& w_hh, const RowMatrixXf& b_ih,
                          const RowMatrixXf& b_hh, WeightFormat format) {
  const int hidden = static_cast<int>(w_hh.cols());
  const int panels = RoundUp(hidden, kPanel) / kPanel;
  char* vectors = Add(Describe(format, static_cast<int>(w_ih.cols()), hidden, panels));
  const Cell cell = cells_.back();
  const size_t vector = static_cast<size_t>(panels) * kRowBytes;
  char* matrix = vectors + NumVectors(format) * vector;
  for (int p = 0; p < panels; ++p) {
    char* row = vectors + static_cast<size_t>(p) * kRowBytes;
    char* h_rows = matrix + static_cast<size_t>(p) * cell.h_rows * kRowBytes;
    char* x_rows =
        matrix +
        (static_cast<size_t>(panels) * cell.h_rows + static_cast<size_t>(p) * cell.x_rows) * kRowBytes;
    for (int lane = 0; lane < kPanelGates; ++lane) {
      const int unit = p * kPanel + lane % kPanel;
      if (unit >= hidden) continue;
      const int source = lane / kPanel * hidden + unit;
      const float bias = b_ih(source, 0) + b_hh(source, 0);
      std::memcpy(row + 4 * lane, &bias, 4);
      PackRow(w_hh, source, lane, format, h_rows, row + vector, row + 3 * vector);
      PackRow(w_ih, source, lane, format, x_rows, row + 2 * vector, row + 4 * vector);
    }
  }
}

void PackedCells::AddLinear(const RowMatrixXf& w, const RowMatrixXf& b) {
  const int rows = static_cast<int>(w.rows());
  const int panels = RoundUp(rows, kPanelGates) / kPanelGates;
  char* vectors = Add(Describe(WeightFormat::kFp32, static_cast<int>(w.cols()), 0, panels));
  char* matrix = vectors + static_cast<size_t>(panels) * kRowBytes;
  for (int row = 0; row < rows; ++row) {
    const size_t panel = row / kPanelGates;
    const int lane = row % kPanelGates;
    std::memcpy(vectors + panel * kRowBytes + 4 * lane, &b(row, 0), 4);
    PackRow(w, row, lane, WeightFormat::kFp32, matrix + panel * cells_.back().x_rows * kRowBytes, nullptr,
            nullptr);
  }
}

}  // namespace intabs
