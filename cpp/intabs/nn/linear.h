// y = W x + b. Forward is real-time safe; y and x must not overlap.
#pragma once

#include <Eigen/Core>

#include "intabs/nn/weights.h"

namespace intabs {

template <typename Scalar>
class Linear {
 public:
  using Vector = Eigen::Matrix<Scalar, Eigen::Dynamic, 1>;

  Linear() = default;
  Linear(const RowMatrixXf& weight, const RowMatrixXf& bias)
      : weight_(weight.cast<Scalar>()), bias_(bias.col(0).cast<Scalar>()) {}

  int input_size() const { return static_cast<int>(weight_.cols()); }
  int output_size() const { return static_cast<int>(weight_.rows()); }

  void Forward(const Scalar* x, Scalar* y) const noexcept {
    Eigen::Map<Vector> out(y, output_size());
    out = bias_;
    out.noalias() += weight_ * Eigen::Map<const Vector>(x, input_size());
  }

  // One input a row: Y (T x out) = X (T x in) W' + b'. Y is given in its size; may allocate inside Eigen.
  template <typename In, typename Out>
  void ForwardRows(const In& X, Out& Y) const {
    Y.noalias() = X * weight_.transpose();
    Y.rowwise() += bias_.transpose();
  }

 private:
  Eigen::Matrix<Scalar, Eigen::Dynamic, Eigen::Dynamic, Eigen::ColMajor> weight_;
  Vector bias_;
};

}  // namespace intabs
