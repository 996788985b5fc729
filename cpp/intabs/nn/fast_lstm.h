// Stacked LSTM on the kernels: what the networks run. float; fp32, 16 or 8 bit weights; bidirectional stacks
// in Sequence only. The equations are lstm.h's; held against it by tests.
//
// Three ways to run: Step (one tick, carried state), Sequence (a whole trajectory from zero state: the input
// products of a layer are one matrix product), LstmBatch (many states side by side).
#pragma once

#include <string>
#include <vector>

#include "intabs/nn/packed.h"
#include "intabs/nn/second_thread.h"
#include "intabs/nn/weights.h"

namespace intabs {

// Weights and shape; no state. Copies are deep.
struct LstmStack {
  LstmStack(const WeightsFile& file, const std::string& net, WeightFormat format, Isa isa);

  int num_layers() const { return spec.layers; }
  int directions() const { return spec.bidirectional ? 2 : 1; }
  int padded_hidden() const { return RoundUp(spec.hidden, kPanel); }
  int padded_width() const { return RoundUp(std::max(spec.lstm_input(), spec.layer_output()), kPanelGates); }
  Cell cell(int layer, int direction = 0) const noexcept {
    return cells.cell(layer * directions() + direction);
  }
  // Layer norm on the input of layer >= 1; out may be in.
  void Normalise(int layer, const float* in, float* out) const noexcept;

  NetworkSpec spec;
  const Kernels* kernels;
  PackedCells cells;
  std::vector<AlignedFloats> norm_weight, norm_bias;  // of layer l at l; empty without layer norm
};

class FastLstm {
 public:
  FastLstm(const WeightsFile& file, const std::string& net, WeightFormat format, Isa isa = BestIsa());

  const LstmStack& stack() const { return stack_; }

  // One tick. x: spec.lstm_input() values, 64-byte aligned, readable and finite up to the next multiple
  // of 16. Returns the top layer's output, spec.hidden values, valid until the next call. Real-time safe. Not
  // bidirectional.
  const float* Step(const float* x) noexcept;
  void Reset() noexcept;
  int state_size() const { return 2 * stack_.num_layers() * stack_.spec.hidden; }
  void SaveState(float* out) const noexcept;  // h of every layer, then c of every layer
  void RestoreState(const float* in) noexcept;

  // X: T columns of lstm_input() values, `ld` apart (laid out as for Kernels). Returns T columns of
  // layer_output() values, ld_out() apart, valid until the next call. threads = 2: one a direction, if
  // bidirectional. The state of Step is left alone. Allocates only when T is larger than ever before (and for
  // the thread).
  const float* Sequence(const float* X, ptrdiff_t ld, int T, int threads = 1);
  ptrdiff_t ld_out() const { return stack_.padded_width(); }

 private:
  // Y <- the layer's outputs in directions first .. last, from `in`, with the residual path from X (the same
  // but for layer norm). Two directions take turns tick by tick: neither waits for its own last gates.
  void Directions(int layer, int first, int last, const float* in, ptrdiff_t ld_in, const float* X,
                  ptrdiff_t ld, int T, float* Y) noexcept;

  LstmStack stack_;
  AlignedFloats h_[2];  // before and after the tick, by turns: layers x padded hidden
  AlignedFloats c_;
  int now_ = 0;  // h_[now_] is the state
  AlignedFloats x_, normalised_, gates_, scratch_;

  struct {
    int T = 0;
    AlignedFloats rows[2], normalised;
    struct {
      AlignedFloats gates, h, c, scratch;
    } direction[2];
  } sequence_;
  SecondThread second_;
};

// n states side by side under one set of weights (a copy of those given). Real-time safe but for the
// constructor.
class LstmBatch {
 public:
  LstmBatch(const LstmStack& stack, int n);

  int size() const { return n_; }
  // One tick of all. X: n columns of lstm_input() values, `ld` apart. Returns n columns of hidden values,
  // ld_out() apart.
  const float* Step(const float* X, ptrdiff_t ld) noexcept;
  ptrdiff_t ld_out() const { return stack_.padded_width(); }
  void Reset() noexcept;
  void SaveState(int j, float* out) const noexcept;  // as FastLstm's
  void RestoreState(int j, const float* in) noexcept;

 private:
  float* h(int which, int layer) noexcept {
    return h_[which].data() + static_cast<ptrdiff_t>(layer) * n_ * ldh_;
  }

  LstmStack stack_;
  int n_;
  ptrdiff_t ldh_;
  AlignedFloats h_[2], c_;  // layers x n x padded hidden
  int now_ = 0;
  AlignedFloats x_, normalised_, gates_, scratch_;
};

}  // namespace intabs
