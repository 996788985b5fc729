// A whole network in plain Eigen, float or double: what Network is held against, and what the error of the 16
// and 8 bit formats is measured against (double). Not real-time safe.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "intabs/nn/linear.h"
#include "intabs/nn/lstm.h"
#include "intabs/nn/weights.h"

namespace intabs {

template <typename Scalar>
class ReferenceNetwork {
 public:
  using Rows = typename BiLstm<Scalar>::Rows;

  ReferenceNetwork(const WeightsFile& file, const std::string& name) : spec_(file.manifest().network(name)) {
    if (spec_.input_linear > 0) {
      input_.emplace(file.tensor(name + ".input.weight"), file.tensor(name + ".input.bias"));
    }
    if (spec_.bidirectional) {
      bilstm_.emplace(file, name);
    } else {
      lstm_.emplace(file, name);
    }
    for (const HeadSpec& h : spec_.heads) {
      heads_.emplace_back(file.tensor(name + ".heads." + h.name + ".weight"),
                          file.tensor(name + ".heads." + h.name + ".bias"));
    }
  }

  const NetworkSpec& spec() const { return spec_; }

  // X: T x input, from zero state. heads[i]: T x size of head i. Returns the top layer's output, T x
  // layer_output().
  Rows Sequence(const Rows& X, std::vector<Rows>& heads) {
    const Rows in = input_ ? Map(*input_, X) : X;
    Rows top(X.rows(), spec_.layer_output());
    if (bilstm_) {
      bilstm_->Sequence(in, top);
    } else {
      lstm_->Reset();
      for (int t = 0; t < X.rows(); ++t) lstm_->Step(in.row(t).data(), top.row(t).data());
    }
    heads.clear();
    Rows read(X.rows(), spec_.head_input());
    read.leftCols(spec_.layer_output()) = top;
    if (spec_.skip) read.rightCols(spec_.input) = X;
    for (const auto& head : heads_) heads.push_back(Map(head, read));
    return top;
  }

 private:
  static Rows Map(const Linear<Scalar>& linear, const Rows& X) {
    Rows Y(X.rows(), linear.output_size());
    for (int t = 0; t < X.rows(); ++t) linear.Forward(X.row(t).data(), Y.row(t).data());
    return Y;
  }

  NetworkSpec spec_;
  std::optional<Linear<Scalar>> input_;
  std::optional<Lstm<Scalar>> lstm_;
  std::optional<BiLstm<Scalar>> bilstm_;
  std::vector<Linear<Scalar>> heads_;
};

}  // namespace intabs
