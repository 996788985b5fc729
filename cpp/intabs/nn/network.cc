#include "intabs/nn/network.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

namespace intabs {

Network Network::Load(const std::string& dir, const std::string& name) {
  return Network(WeightsFile::Load(dir), name);
}

Network::Network(const WeightsFile& file, const std::string& name)
    : name_(name), spec_(file.manifest().network(name)) {
  if (spec_.input_linear > 0) {
    input_.emplace(file.tensor(name + ".input.weight"), file.tensor(name + ".input.bias"));
  }
  if (spec_.bidirectional) {
    bilstm_.emplace(file, name);
  } else {
    lstm_.emplace(file, name);
  }
  for (const HeadSpec& h : spec_.heads) {
    const std::string prefix = name + ".heads." + h.name;
    heads_.emplace_back(file.tensor(prefix + ".weight"), file.tensor(prefix + ".bias"));
    head_out_.emplace_back(Eigen::VectorXf::Zero(h.size));
  }
  x_.setZero(spec_.lstm_input());
  top_.setZero(spec_.layer_output());
}

bool Network::HasHead(std::string_view name) const noexcept {
  return std::any_of(spec_.heads.begin(), spec_.heads.end(), [&](const HeadSpec& h) { return h.name == name; });
}

int Network::HeadIndex(std::string_view name) const {
  std::string known;
  for (int i = 0; i < num_heads(); ++i) {
    if (head_name(i) == name) return i;
    known += (i > 0 ? ", " : "") + head_name(i);
  }
  throw std::runtime_error("network \"" + name_ + "\" has no head \"" + std::string(name) + "\"; it has " + known);
}

Status Network::Step(const float* x) noexcept {
  if (!lstm_) return Status::kNotReady;
  for (int i = 0; i < spec_.input; ++i) {
    if (!std::isfinite(x[i])) return Status::kInvalidInput;
  }
  if (input_) {
    input_->Forward(x, x_.data());
    x = x_.data();
  }
  lstm_->Step(x, top_.data());
  for (size_t i = 0; i < heads_.size(); ++i) heads_[i].Forward(top_.data(), head_out_[i].data());
  return Status::kOk;
}

void Network::Reset() noexcept {
  if (lstm_) lstm_->Reset();
}
int Network::state_size() const { return lstm_ ? lstm_->state_size() : 0; }
void Network::SaveState(float* out) const noexcept {
  if (lstm_) lstm_->SaveState(out);
}
void Network::RestoreState(const float* in) noexcept {
  if (lstm_) lstm_->RestoreState(in);
}

const RowMatrixXf& Network::Top(const Eigen::Ref<const RowMatrixXf>& X) {
  if (X.cols() != spec_.input || X.rows() < 1) {
    throw std::invalid_argument("network \"" + name_ + "\": the sequence is " + std::to_string(X.rows()) + "x" +
                                std::to_string(X.cols()) + ", wanted Tx" + std::to_string(spec_.input) + ", T >= 1");
  }
  seq_in_.resize(X.rows(), spec_.lstm_input());
  if (input_) {
    input_->ForwardRows(X, seq_in_);
  } else {
    seq_in_ = X;
  }
  if (bilstm_) {
    bilstm_->Sequence(seq_in_, seq_top_);
  } else {
    std::vector<float> state(lstm_->state_size());
    lstm_->SaveState(state.data());
    lstm_->Reset();
    seq_top_.resize(X.rows(), spec_.layer_output());
    for (int t = 0; t < X.rows(); ++t) lstm_->Step(seq_in_.row(t).data(), seq_top_.row(t).data());
    lstm_->RestoreState(state.data());
  }
  return seq_top_;
}

void Network::Sequence(const Eigen::Ref<const RowMatrixXf>& X, std::vector<RowMatrixXf>& heads) {
  const RowMatrixXf& top = Top(X);
  heads.resize(heads_.size());
  for (size_t i = 0; i < heads_.size(); ++i) {
    heads[i].resize(X.rows(), head_size(static_cast<int>(i)));
    heads_[i].ForwardRows(top, heads[i]);
  }
}

void Network::EncodeFinal(const Eigen::Ref<const RowMatrixXf>& X) {
  const RowMatrixXf& top = Top(X);
  const int H = spec_.hidden;
  top_.head(H) = top.row(top.rows() - 1).head(H);
  if (spec_.bidirectional) top_.tail(H) = top.row(0).tail(H);
  for (size_t i = 0; i < heads_.size(); ++i) heads_[i].Forward(top_.data(), head_out_[i].data());
}

}  // namespace intabs
