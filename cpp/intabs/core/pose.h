// Poses and rotations in monogram notation: X_WO is the pose of O in W, p_WO its position [m], R_WO its rotation.
// Everything here is fixed-size and real-time safe.
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <cmath>

namespace intabs {

// Pose of frame B in frame A. `q` is kept at unit norm by whoever writes it.
struct Pose {
  Eigen::Vector3d p = Eigen::Vector3d::Zero();              // p_AB [m]
  Eigen::Quaterniond q = Eigen::Quaterniond::Identity();    // R_AB

  Pose operator*(const Pose& X_BC) const { return {p + q * X_BC.p, (q * X_BC.q).normalized()}; }
  Eigen::Vector3d operator*(const Eigen::Vector3d& p_BT) const { return p + q * p_BT; }
  Pose Inverse() const {
    const Eigen::Quaterniond qi = q.conjugate();
    return {-(qi * p), qi};
  }
  bool IsFinite() const { return p.allFinite() && q.coeffs().allFinite(); }
};

// Rotation vector [rad] to rotation (Rodrigues). Exact limit at zero.
inline Eigen::Quaterniond ExpSO3(const Eigen::Vector3d& w) {
  const double angle = w.norm();
  const double half = 0.5 * angle;
  // sin(a/2)/a -> 1/2 - a^2/48 near zero
  const double k = angle > 1e-6 ? std::sin(half) / angle : 0.5 - angle * angle / 48.0;
  return Eigen::Quaterniond(std::cos(half), k * w.x(), k * w.y(), k * w.z()).normalized();
}

// Rotation to rotation vector [rad], angle in [0, pi]. Does not care about the quaternion's sign.
inline Eigen::Vector3d LogSO3(const Eigen::Quaterniond& q_in) {
  const double sign = q_in.w() < 0 ? -1.0 : 1.0;
  const Eigen::Vector3d v = sign * q_in.vec();
  const double w = sign * q_in.w();
  const double n = v.norm();
  const double angle = 2.0 * std::atan2(n, w);
  return n > 1e-12 ? Eigen::Vector3d(v * (angle / n)) : Eigen::Vector3d(2.0 * v);
}

// Geodesic angle between two rotations [rad], in [0, pi].
inline double AngleBetween(const Eigen::Quaterniond& a, const Eigen::Quaterniond& b) {
  return LogSO3(a.conjugate() * b).norm();
}

// First two columns of R: the 6-D rotation representation of Zhou et al., CVPR 2019.
inline Eigen::Matrix<double, 6, 1> To6D(const Eigen::Quaterniond& q) {
  const Eigen::Matrix3d R = q.toRotationMatrix();
  Eigen::Matrix<double, 6, 1> out;
  out << R.col(0), R.col(1);
  return out;
}

}  // namespace intabs
