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
  c.header_rows = format == WeightFormat::k8 ? 5 : 1;
  c.h_rows = RoundUp(hidden, per_word) / per_word;
  c.x_rows = RoundUp(input, per_word) / per_word;
  c.panel_bytes = static_cast<size_t>(c.header_rows + c.h_rows + c.x_rows) * kRowBytes;
  return c;
}

// Row `source` of W becomes lane `lane` of a panel's rows at `out`. 8 bit: also its scale, and 128 times its sum.
void PackRow(const RowMatrixXf& W, int source, int lane, WeightFormat format, char* out, char* scale, char* sum) {
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
        // Clamped: the division may round past 127, and is undone by no step at all where all are zero or denormal.
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

}  // namespace

char* PackedCells::Add(const Cell& cell) {
  const size_t offset = memory_.size() * sizeof(float);
  memory_.resize(memory_.size() + cell.panel_bytes * cell.panels / sizeof(float));
  cells_.push_back(cell);
  offsets_.push_back(offset);
  return reinterpret_cast<char*>(memory_.data()) + offset;
}

void PackedCells::AddLstm(const RowMatrixXf& w_ih, const RowMatrixXf& w_hh, const RowMatrixXf& b_ih,
                          const RowMatrixXf& b_hh, WeightFormat format) {
  const int hidden = static_cast<int>(w_hh.cols());
  const Cell cell = Describe(format, static_cast<int>(w_ih.cols()), hidden, RoundUp(hidden, kPanel) / kPanel);
  char* panel = Add(cell);
  for (int p = 0; p < cell.panels; ++p, panel += cell.panel_bytes) {
    char* h_rows = panel + cell.header_rows * kRowBytes;
    char* x_rows = h_rows + cell.h_rows * kRowBytes;
    for (int lane = 0; lane < kPanelGates; ++lane) {
      const int unit = p * kPanel + lane % kPanel;
      if (unit >= hidden) continue;
      const int source = lane / kPanel * hidden + unit;
      const float bias = b_ih(source, 0) + b_hh(source, 0);
      std::memcpy(panel + 4 * lane, &bias, 4);
      PackRow(w_hh, source, lane, format, h_rows, panel + kRowBytes, panel + 3 * kRowBytes);
      PackRow(w_ih, source, lane, format, x_rows, panel + 2 * kRowBytes, panel + 4 * kRowBytes);
    }
  }
}

void PackedCells::AddLinear(const RowMatrixXf& w, const RowMatrixXf& b) {
  const int rows = static_cast<int>(w.rows());
  const Cell cell = Describe(WeightFormat::kFp32, static_cast<int>(w.cols()), 0, RoundUp(rows, kPanelGates) / kPanelGates);
  char* panel = Add(cell);
  for (int row = 0; row < rows; ++row) {
    char* base = panel + row / kPanelGates * cell.panel_bytes;
    const int lane = row % kPanelGates;
    std::memcpy(base + 4 * lane, &b(row, 0), 4);
    PackRow(w, row, lane, WeightFormat::kFp32, base + kRowBytes, nullptr, nullptr);
  }
}

}  // namespace intabs
