// A network of the manifest: [input linear] -> stacked LSTM -> named linear heads. float. Format: nn/weights.h.
//
//   Network pi = Network::Load("models/weights/pick_place", "pi");       // throws, one line
//   const int mean = pi.HeadIndex("agent_mean");                         // once, at set-up
//   if (pi.Step(x) != Status::kOk) ...                                   // real-time safe
//   pi.Head(mean)                                                        // float vector, valid until the next call
//
// A copy has its own state and its own weights. One thread at a time per object.
#pragma once

#include <Eigen/Core>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "intabs/core/status.h"
#include "intabs/nn/linear.h"
#include "intabs/nn/lstm.h"
#include "intabs/nn/weights.h"

namespace intabs {

class Network {
 public:
  static Network Load(const std::string& dir, const std::string& name);
  Network(const WeightsFile& file, const std::string& name);

  const NetworkSpec& spec() const { return spec_; }
  int input_size() const { return spec_.input; }

  int num_heads() const { return static_cast<int>(heads_.size()); }
  const std::string& head_name(int head) const { return spec_.heads[head].name; }
  int head_size(int head) const { return spec_.heads[head].size; }
  bool HasHead(std::string_view name) const noexcept;
  int HeadIndex(std::string_view name) const;  // unknown: throws and lists the known ones

  // One tick with carried state. x: input_size() values. kInvalidInput: a value is not finite, kNotReady: the network
  // is bidirectional and has no tick; both leave state and heads alone. Real-time safe.
  Status Step(const float* x) noexcept;
  // Output of a head after Step or EncodeFinal. Real-time safe.
  Eigen::Map<const Eigen::VectorXf> Head(int head) const noexcept {
    return {head_out_[head].data(), head_out_[head].size()};
  }

  // State of the stack (none for a bidirectional network): h of every layer, then c of every layer. Real-time safe.
  void Reset() noexcept;
  int state_size() const;
  void SaveState(float* out) const noexcept;
  void RestoreState(const float* in) noexcept;

  // A whole trajectory from zero state: X is T x input_size(), T >= 1, one time a row. Both leave the state of Step as
  // it is, and throw std::invalid_argument on a wrong shape. heads[i] becomes T x head_size(i).
  void Sequence(const Eigen::Ref<const RowMatrixXf>& X, std::vector<RowMatrixXf>& heads);
  // For encoders: Head(i) afterwards is head i on the top layer's [forward output at T-1, backward output at 0], or on
  // its output at T-1 if not bidirectional. (With `residual` the output includes the residual path.)
  void EncodeFinal(const Eigen::Ref<const RowMatrixXf>& X);

 private:
  const RowMatrixXf& Top(const Eigen::Ref<const RowMatrixXf>& X);  // T x layer_output

  std::string name_;
  NetworkSpec spec_;
  std::optional<Linear<float>> input_;
  std::optional<Lstm<float>> lstm_;
  std::optional<BiLstm<float>> bilstm_;
  std::vector<Linear<float>> heads_;
  Eigen::VectorXf x_;    // after the input linear
  Eigen::VectorXf top_;  // top layer's output
  std::vector<Eigen::VectorXf> head_out_;
  RowMatrixXf seq_in_, seq_top_;
};

}  // namespace intabs
