// y = W x + b in Eigen, float or double (the reference). Forward is real-time safe; y and x must not overlap.
#pragma once

#include <Eigen/Core>

#include "intabs/nn/weights.h"

namespace intabs {

template <typename Scalar>
class Linear {
 public:
  using Vector = Eigen::Matrix<Scalar, Eigen::Dynamic, 1>;

  Linear(const RowMatrixXf& weight, const RowMatrixXf& bias)
      : weight_(weight.cast<Scalar>()), bias_(bias.col(0).cast<Scalar>()) {}

  int input_size() const { return static_cast<int>(weight_.cols()); }
  int output_size() const { return static_cast<int>(weight_.rows()); }

  void Forward(const Scalar* x, Scalar* y) const noexcept {
    Eigen::Map<Vector> out(y, output_size());
    out = bias_;
    out.noalias() += weight_ * Eigen::Map<const Vector>(x, input_size());
  }

 private:
  Eigen::Matrix<Scalar, Eigen::Dynamic, Eigen::Dynamic> weight_;
  Vector bias_;
};

}  // namespace intabs
