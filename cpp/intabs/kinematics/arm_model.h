// Forward kinematics and Jacobian of a 6R arm. Fixed-size, noexcept, allocates nothing: real-time safe.
// Frames: B arm base, J_i frame of link i (turns about its z by q_i), E flange = J_6, G gripper tip.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

#include "intabs/core/pose.h"
#include "intabs/core/types.h"

namespace intabs {

// Rows: linear velocity [m/s], then angular velocity [rad/s] of the tip, both in B; columns: joints.
using ArmJacobian = Eigen::Matrix<double, 6, kNumJoints>;

struct ArmParameters {
  std::array<Pose, kNumJoints>
      X_PJ;   // frame of joint i, at q_i = 0, in the link before it (the base for i = 0)
  Pose X_EG;  // tip in the flange
  JointVector q_min = JointVector::Constant(-2 * std::numbers::pi);  // [rad]
  JointVector q_max = JointVector::Constant(2 * std::numbers::pi);   // [rad]
};

class ArmModel {
 public:
  explicit ArmModel(const ArmParameters& parameters) noexcept : parameters_(parameters) {
    for (int i = 0; i < kNumJoints; ++i) R_PJ_[i] = parameters.X_PJ[i].q.toRotationMatrix();
  }

  // The nominal Lite 6 with its gripper; models/lite6/lite6.urdf says the same. A real arm is calibrated and
  // is up to a few millimetres off: load its own URDF (urdf.h).
  static ArmModel Lite6() noexcept {
    ArmParameters a;
    const double h = std::sqrt(0.5);
    a.X_PJ[0] = {{0, 0, 0.2435}, Eigen::Quaterniond::Identity()};
    a.X_PJ[1] = {{0, 0, 0}, {-0.5, 0.5, 0.5, 0.5}};
    a.X_PJ[2] = {{0.2002, 0, 0}, {0, -h, -h, 0}};
    a.X_PJ[3] = {{0.087, -0.22761, 0}, {h, h, 0, 0}};
    a.X_PJ[4] = {{0, 0, 0}, {h, h, 0, 0}};
    a.X_PJ[5] = {{0, 0.0625, 0}, {h, -h, 0, 0}};
    a.X_EG.p.z() = 0.0836;
    constexpr double kDegree = std::numbers::pi / 180;
    a.q_min << -360, -150, -3.5, -360, -124, -360;
    a.q_max << 360, 150, 300, 360, 124, 360;
    a.q_min *= kDegree;
    a.q_max *= kDegree;
    return ArmModel(a);
  }

  // X_BE, the flange. The sign of the quaternion is arbitrary.
  Pose Fk(const JointVector& q) const noexcept {
    const Chain chain = Walk(q);
    return {chain.p[kNumJoints - 1], Eigen::Quaterniond(chain.R[kNumJoints - 1])};
  }

  // X_BG, the tip.
  Pose Tip(const JointVector& q) const noexcept { return Fk(q) * parameters_.X_EG; }

  // The arm's line in B [m]: the base, the origins of J_1 ... J_6, the tip.
  using Line = std::array<Eigen::Vector3d, kNumJoints + 2>;
  Line Places(const JointVector& q) const noexcept {
    const Chain chain = Walk(q);
    Line line;
    line[0].setZero();
    for (int i = 0; i < kNumJoints; ++i) line[i + 1] = chain.p[i];
    line[kNumJoints + 1] = chain.p[kNumJoints - 1] + chain.R[kNumJoints - 1] * parameters_.X_EG.p;
    return line;
  }

  // Of a point p_BX from the line's part from the elbow (J_3) to the tip [m]; the arm's body is some 4 cm thick around it.
  double DistanceFrom(const JointVector& q, const Eigen::Vector3d& p_BX) const noexcept {
    const Line line = Places(q);
    double least = (p_BX - line[3]).squaredNorm();
    for (size_t i = 4; i < line.size(); ++i) {
      const Eigen::Vector3d along = line[i] - line[i - 1], to = p_BX - line[i - 1];
      const double length = along.squaredNorm();
      const double t = length > 0 ? std::clamp(to.dot(along) / length, 0.0, 1.0) : 0.0;
      least = std::min(least, (to - t * along).squaredNorm());
    }
    return std::sqrt(least);
  }

  // At the tip.
  ArmJacobian Jacobian(const JointVector& q) const noexcept {
    Pose X_BG;
    return TipAndJacobian(q, X_BG);
  }

  // Both for one walk along the chain.
  ArmJacobian TipAndJacobian(const JointVector& q, Pose& X_BG) const noexcept {
    const Chain chain = Walk(q);
    X_BG = Pose{chain.p[kNumJoints - 1], Eigen::Quaterniond(chain.R[kNumJoints - 1])} * parameters_.X_EG;
    ArmJacobian J;
    for (int i = 0; i < kNumJoints; ++i) {
      const Eigen::Vector3d axis = chain.R[i].col(2);
      J.col(i) << axis.cross(X_BG.p - chain.p[i]), axis;
    }
    return J;
  }

  const ArmParameters& parameters() const noexcept { return parameters_; }
  const JointVector& q_min() const noexcept { return parameters_.q_min; }
  const JointVector& q_max() const noexcept { return parameters_.q_max; }

 private:
  struct Chain {
    std::array<Eigen::Matrix3d, kNumJoints> R;  // R_BJi
    std::array<Eigen::Vector3d, kNumJoints> p;  // p_BJi
  };

  Chain Walk(const JointVector& q) const noexcept {
    Chain chain;
    for (int i = 0; i < kNumJoints; ++i) {
      Eigen::Matrix3d& R = chain.R[i];
      if (i == 0) {
        chain.p[0] = parameters_.X_PJ[0].p;
        R = R_PJ_[0];
      } else {
        chain.p[i] = chain.p[i - 1] + chain.R[i - 1] * parameters_.X_PJ[i].p;
        R.noalias() = chain.R[i - 1] * R_PJ_[i];
      }
      const double c = std::cos(q[i]), s = std::sin(q[i]);
      const Eigen::Vector3d x = R.col(0);
      R.col(0) = c * x + s * R.col(1);
      R.col(1) = c * R.col(1) - s * x;
    }
    return chain;
  }

  ArmParameters parameters_;
  std::array<Eigen::Matrix3d, kNumJoints> R_PJ_;
};

}  // namespace intabs
