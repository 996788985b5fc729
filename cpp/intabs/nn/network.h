// A network of the manifest: [input linear] -> stacked LSTM -> named linear heads. float. Format:
// nn/weights.h.
//
//   Network pi = Network::Load("models/weights/pick_place", "pi");       // throws, one line
//   const int mean = pi.HeadIndex("agent_mean");                         // once, at set-up
//   if (pi.Step(x) != Status::kOk) ...                                   // real-time safe
//   pi.Head(mean)                                                        // float vector, valid until the
//   next call
//
// A copy has its own state and its own weights. One thread at a time per object.
#pragma once

#include <Eigen/Core>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "intabs/core/status.h"
#include "intabs/nn/fast_lstm.h"
#include "intabs/nn/packed.h"
#include "intabs/nn/weights.h"

namespace intabs {

struct NetworkOptions {
  std::optional<WeightFormat> format =
      std::nullopt;  // of the LSTM's weights; unset: the manifest's. The linear maps stay fp32
  Isa isa = BestIsa();
};

class Network {
 public:
  static Network Load(const std::string& dir, const std::string& name, const NetworkOptions& options = {});
  Network(const WeightsFile& file, const std::string& name, const NetworkOptions& options = {});

  const NetworkSpec& spec() const { return spec_; }  // format: the one in use
  int input_size() const { return spec_.input; }
  size_t weight_bytes() const;  // what one Step reads

  int num_heads() const { return static_cast<int>(spec_.heads.size()); }
  const std::string& head_name(int head) const { return spec_.heads[head].name; }
  int head_size(int head) const { return spec_.heads[head].size; }
  bool HasHead(std::string_view name) const noexcept;
  int HeadIndex(std::string_view name) const;  // unknown: throws and lists the known ones

  // One tick with carried state. x: input_size() values. kInvalidInput: a value is not finite, kNotReady: the
  // network is bidirectional and has no tick; both leave state and heads alone. Real-time safe.
  Status Step(const float* x) noexcept;
  // Output of a head after Step or EncodeFinal. Real-time safe.
  Eigen::Map<const Eigen::VectorXf> Head(int head) const noexcept {
    return {head_out_.data() + head_offset_[head], head_size(head)};
  }

  // State of the stack (none for a bidirectional network): h of every layer, then c of every layer. Real-time
  // safe.
  void Reset() noexcept;
  int state_size() const;
  void SaveState(float* out) const noexcept;
  void RestoreState(const float* in) noexcept;

  // A whole trajectory from zero state: X is T x input_size(), T >= 1, one time a row. Both leave the state
  // of Step as it is, and throw std::invalid_argument on a wrong shape. heads[i] becomes T x head_size(i).
  // threads = 2: one a direction of a bidirectional network. No allocation once T has been as large before
  // (and the second thread, and `heads`, are there).
  void Sequence(const Eigen::Ref<const RowMatrixXf>& X, std::vector<RowMatrixXf>& heads, int threads = 1);
  // For encoders: Head(i) afterwards is, with pool "mean", the mean over the ticks of what Sequence gives; else
  // head i on the top layer's [forward output at T-1, backward output at 0], or on its output at T-1 if not
  // bidirectional (with `skip`, beside the input at T-1). With `residual` the output includes the residual path.
  void EncodeFinal(const Eigen::Ref<const RowMatrixXf>& X, int threads = 1);

 private:
  friend class NetworkBatch;

  // What the heads read: T columns of head_input(), head_ld() apart.
  const float* Top(const Eigen::Ref<const RowMatrixXf>& X, int threads);
  ptrdiff_t head_ld() const noexcept;
  void Heads(const float* top, ptrdiff_t ld, int n, float* out, void* scratch) const noexcept;
  ptrdiff_t heads_ld() const noexcept;

  std::string name_;
  NetworkSpec spec_;
  FastLstm lstm_;
  const Kernels* kernels_;
  PackedCells input_;  // none or one
  PackedCells heads_;  // one: all heads below each other
  std::vector<int> head_offset_;
  AlignedFloats x_, linear_, head_out_, top_, scratch_;
  AlignedFloats seq_x_, seq_linear_, seq_top_, seq_heads_, seq_scratch_;
};

// n copies of a network's state that step together, for planning: one set of weights (its own copy), which
// each tick reads once for all. Real-time safe but for the constructor.
class NetworkBatch {
 public:
  NetworkBatch(const Network& net, int n);  // throws if bidirectional or n < 1

  int size() const { return lstm_.size(); }
  const Network& network() const { return net_; }
  // One tick of all. X: n x input_size(), row by row, without gaps. kInvalidInput: nothing was done.
  Status Step(const float* X) noexcept;
  // n x head_size(head), valid until the next call.
  Eigen::Map<const RowMatrixXf, 0, Eigen::OuterStride<>> Head(int head) const noexcept {
    return {head_out_.data() + net_.head_offset_[head], size(), net_.head_size(head),
            Eigen::OuterStride<>(net_.heads_ld())};
  }
  void Reset() noexcept;
  void SaveState(int j, float* out) const noexcept;  // of rollout j, as Network's
  void RestoreState(int j, const float* in) noexcept;

 private:
  Network net_;
  LstmBatch lstm_;
  AlignedFloats x_, linear_, top_, head_out_, scratch_;
};

}  // namespace intabs
