// Stacked LSTM in plain Eigen, float or double: the reference that the kernels (fast_lstm.h) are held
// against. Torch's equations and gate order (torch.nn.LSTM):
//   [i f g o] = W_ih x + W_hh h + b_ih + b_hh,  c' = sigmoid(f) c + sigmoid(i) tanh(g),  h' = sigmoid(o)
//   tanh(c')
// With `residual` a layer >= 1 hands up h' + its input; what it carries to the next tick stays h'. With
// `layer_norm` a layer >= 1 reads the normalised input (torch.nn.LayerNorm); the residual path goes past the
// norm.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

#include "intabs/nn/weights.h"

namespace intabs {

// One direction of one layer: a fused column-major matrix [W_ih W_hh] against [x; h], so that one pass over
// memory serves both, and one bias.
template <typename Scalar>
class LstmCell {
 public:
  using Matrix = Eigen::Matrix<Scalar, Eigen::Dynamic, Eigen::Dynamic>;
  using Vector = Eigen::Matrix<Scalar, Eigen::Dynamic, 1>;

  LstmCell(const WeightsFile& file, const std::string& prefix, const std::string& suffix) {
    const RowMatrixXf& w_ih = file.tensor(prefix + "weight_ih" + suffix);
    const RowMatrixXf& w_hh = file.tensor(prefix + "weight_hh" + suffix);
    hidden_ = static_cast<int>(w_hh.cols());
    input_ = static_cast<int>(w_ih.cols());
    weight_.resize(4 * hidden_, input_ + hidden_);
    weight_ << w_ih.cast<Scalar>(), w_hh.cast<Scalar>();
    bias_ = file.tensor(prefix + "bias_ih" + suffix).col(0).template cast<Scalar>() +
            file.tensor(prefix + "bias_hh" + suffix).col(0).template cast<Scalar>();
    xh_.setZero(input_ + hidden_);
    c_.setZero(hidden_);
    gates_.setZero(4 * hidden_);
  }

  int input_size() const { return input_; }
  int hidden_size() const { return hidden_; }
  Scalar* h() { return xh_.data() + input_; }
  const Scalar* h() const { return xh_.data() + input_; }
  Scalar* c() { return c_.data(); }
  const Scalar* c() const { return c_.data(); }

  void Reset() noexcept {
    xh_.setZero();
    c_.setZero();
  }

  // x: input_size() values. The new h is at h().
  void Step(const Scalar* x) noexcept {
    xh_.head(input_) = Eigen::Map<const Vector>(x, input_);
    gates_ = bias_;
    gates_.noalias() += weight_ * xh_;
    const Scalar* g = gates_.data();
    Scalar* h_out = h();
    for (int k = 0; k < hidden_; ++k) {
      c_[k] = Sigmoid(g[hidden_ + k]) * c_[k] + Sigmoid(g[k]) * std::tanh(g[2 * hidden_ + k]);
      h_out[k] = Sigmoid(g[3 * hidden_ + k]) * std::tanh(c_[k]);
    }
  }

 private:
  static Scalar Sigmoid(Scalar x) { return Scalar(1) / (Scalar(1) + std::exp(-x)); }

  int input_ = 0;
  int hidden_ = 0;
  Matrix weight_;  // 4 hidden x (input + hidden)
  Vector bias_;
  Vector xh_;  // [x; h]
  Vector c_;
  Vector gates_;
};

template <typename Scalar>
class LayerNorm {
 public:
  using Vector = Eigen::Matrix<Scalar, Eigen::Dynamic, 1>;

  LayerNorm(const WeightsFile& file, const std::string& prefix)
      : weight_(file.tensor(prefix + "weight").col(0).template cast<Scalar>()),
        bias_(file.tensor(prefix + "bias").col(0).template cast<Scalar>()) {}

  // out may be in.
  void Forward(const Scalar* in, Scalar* out) const noexcept {
    const Eigen::Map<const Vector> x(in, weight_.size());
    const Scalar mean = x.mean();
    const Scalar variance = (x.array() - mean).square().mean();
    const Scalar scale = Scalar(1) / std::sqrt(variance + Scalar(kLayerNormEpsilon));
    Eigen::Map<Vector>(out, weight_.size()) =
        ((x.array() - mean) * scale * weight_.array() + bias_.array()).matrix();
  }

 private:
  Vector weight_, bias_;
};

// Norms of layers 1, 2, ... at [0], [1], ...; empty without layer norm.
template <typename Scalar>
std::vector<LayerNorm<Scalar>> LayerNorms(const WeightsFile& file, const std::string& net) {
  std::vector<LayerNorm<Scalar>> out;
  const NetworkSpec& spec = file.manifest().network(net);
  for (int l = 1; l < spec.layers && spec.layer_norm; ++l) {
    out.emplace_back(file, net + ".lstm." + std::to_string(l) + ".norm.");
  }
  return out;
}

// Copyable; a copy has weights and state of its own.
template <typename Scalar>
class Lstm {
 public:
  // Network `net` of the file; must not be bidirectional.
  Lstm(const WeightsFile& file, const std::string& net)
      : residual_(file.manifest().network(net).residual), norms_(LayerNorms<Scalar>(file, net)) {
    const NetworkSpec& spec = file.manifest().network(net);
    for (int l = 0; l < spec.layers; ++l)
      cells_.emplace_back(file, net + ".lstm." + std::to_string(l) + ".", "");
    x_.setZero(spec.hidden);
    normalised_.setZero(spec.hidden);
  }

  int input_size() const { return cells_.front().input_size(); }
  int output_size() const { return cells_.front().hidden_size(); }

  // One tick. x: input_size() values, y: output_size() values; may be the same memory. Real-time safe.
  void Step(const Scalar* x, Scalar* y) noexcept {
    const int n = output_size();
    for (size_t l = 0; l < cells_.size(); ++l) {
      if (!norms_.empty() && l > 0) {
        norms_[l - 1].Forward(x, normalised_.data());
        cells_[l].Step(normalised_.data());
      } else {
        cells_[l].Step(x);
      }
      const Scalar* h = cells_[l].h();
      if (residual_ && l > 0) {
        for (int k = 0; k < n; ++k) x_[k] += h[k];
      } else {
        for (int k = 0; k < n; ++k) x_[k] = h[k];
      }
      x = x_.data();
    }
    for (int k = 0; k < n; ++k) y[k] = x_[k];
  }

  // The state: h of every layer, then c of every layer. All of these are real-time safe.
  int state_size() const { return 2 * static_cast<int>(cells_.size()) * output_size(); }
  void Reset() noexcept {
    for (auto& cell : cells_) cell.Reset();
  }
  void SaveState(Scalar* out) const noexcept {
    for (const auto& cell : cells_) out = std::copy_n(cell.h(), output_size(), out);
    for (const auto& cell : cells_) out = std::copy_n(cell.c(), output_size(), out);
  }
  void RestoreState(const Scalar* in) noexcept {
    for (auto& cell : cells_) std::copy_n(in, output_size(), cell.h()), in += output_size();
    for (auto& cell : cells_) std::copy_n(in, output_size(), cell.c()), in += output_size();
  }

 private:
  bool residual_;
  std::vector<LstmCell<Scalar>> cells_;
  std::vector<LayerNorm<Scalar>> norms_;
  Eigen::Matrix<Scalar, Eigen::Dynamic, 1> x_, normalised_;
};

// Bidirectional stack, as torch's: a layer's output at t is [forward h(t), backward h(t)], which the next
// layer reads.
template <typename Scalar>
class BiLstm {
 public:
  using Rows = Eigen::Matrix<Scalar, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

  BiLstm(const WeightsFile& file, const std::string& net)
      : residual_(file.manifest().network(net).residual), norms_(LayerNorms<Scalar>(file, net)) {
    const NetworkSpec& spec = file.manifest().network(net);
    for (int l = 0; l < spec.layers; ++l) {
      const std::string prefix = net + ".lstm." + std::to_string(l) + ".";
      forward_.emplace_back(file, prefix, "");
      backward_.emplace_back(file, prefix, "_reverse");
    }
  }

  int input_size() const { return forward_.front().input_size(); }
  int output_size() const { return 2 * forward_.front().hidden_size(); }

  // X: T x input_size(), one time a row. Y becomes T x output_size(). Starts from zero state; allocates.
  void Sequence(const Eigen::Ref<const Rows>& X, Rows& Y) {
    const int T = static_cast<int>(X.rows()), H = output_size() / 2;
    Rows in = X;
    for (size_t l = 0; l < forward_.size(); ++l) {
      Rows cell_in = in;
      if (!norms_.empty() && l > 0) {
        for (int t = 0; t < T; ++t) norms_[l - 1].Forward(in.row(t).data(), cell_in.row(t).data());
      }
      Y.resize(T, 2 * H);
      Run(forward_[l], cell_in, 0, T, 1, Y, 0);
      Run(backward_[l], cell_in, T - 1, -1, -1, Y, H);
      if (residual_ && l > 0) Y += in;
      in = Y;
    }
  }

 private:
  static void Run(LstmCell<Scalar>& cell, const Rows& in, int from, int to, int step, Rows& Y, int col) {
    cell.Reset();
    for (int t = from; t != to; t += step) {
      cell.Step(in.row(t).data());
      std::copy_n(cell.h(), cell.hidden_size(), Y.row(t).data() + col);
    }
  }

  bool residual_;
  std::vector<LstmCell<Scalar>> forward_, backward_;
  std::vector<LayerNorm<Scalar>> norms_;
};

}  // namespace intabs
