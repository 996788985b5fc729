// The arm's bodies in double precision, written apart from control/stop_guard.cc: what its tests measure
// with.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

#include "intabs/control/arm_shape.h"
#include "intabs/kinematics/arm_model.h"

namespace intabs {

struct ReferenceClearance {
  double self;   // least distance between the surfaces of two capsules that could meet [m]
  double table;  // height of the lowest body above z = 0 [m]
  Eigen::Vector3d tip;
};

inline double SegmentDistance(const Eigen::Vector3d& p0, const Eigen::Vector3d& p1, const Eigen::Vector3d& q0,
                              const Eigen::Vector3d& q1) {
  // Least of: both inside (lines), and each end against the other segment.
  const auto to_segment = [](const Eigen::Vector3d& x, const Eigen::Vector3d& a, const Eigen::Vector3d& b) {
    const double t = std::clamp((x - a).dot(b - a) / (b - a).squaredNorm(), 0.0, 1.0);
    return (x - a - t * (b - a)).norm();
  };
  double least = std::min(
      {to_segment(p0, q0, q1), to_segment(p1, q0, q1), to_segment(q0, p0, p1), to_segment(q1, p0, p1)});
  const Eigen::Vector3d u = p1 - p0, w = q1 - q0, r = p0 - q0, n = u.cross(w);
  if (n.squaredNorm() > 1e-16) {
    const double s = (-r).cross(w).dot(n) / n.squaredNorm(), t = (-r).cross(u).dot(n) / n.squaredNorm();
    if (s >= 0 && s <= 1 && t >= 0 && t <= 1) least = std::min(least, std::abs(r.dot(n)) / n.norm());
  }
  return least;
}

inline ReferenceClearance Measure(const ArmModel& model, const JointVector& q) {
  std::array<Eigen::Matrix3d, 7> R;
  std::array<Eigen::Vector3d, 7> p;
  R[0].setIdentity();
  p[0].setZero();
  for (int i = 0; i < kNumJoints; ++i) {
    const Pose& X = model.parameters().X_PJ[i];
    p[i + 1] = p[i] + R[i] * X.p;
    R[i + 1] = R[i] * X.q.toRotationMatrix() * Eigen::AngleAxisd(q[i], Eigen::Vector3d::UnitZ());
  }
  const auto at = [&](int link, const float* x) -> Eigen::Vector3d {
    return p[link] + R[link] * Eigen::Vector3d(x[0], x[1], x[2]);
  };
  ReferenceClearance c{std::numeric_limits<double>::infinity(), std::numeric_limits<double>::infinity(),
                       p[6] + R[6] * model.parameters().X_EG.p};
  std::array<Eigen::Vector3d, lite6_shape::kCapsules.size()> p0, p1;
  for (size_t i = 0; i < p0.size(); ++i) {
    const auto& k = lite6_shape::kCapsules[i];
    p0[i] = at(k.link, k.p0);
    p1[i] = at(k.link, k.p1);
  }
  for (const auto& pair : lite6_shape::kPairs) {
    const double radii =
        double{lite6_shape::kCapsules[pair.a].radius} + double{lite6_shape::kCapsules[pair.b].radius};
    c.self = std::min(c.self, SegmentDistance(p0[pair.a], p1[pair.a], p0[pair.b], p1[pair.b]) - radii);
  }
  for (const auto& k : lite6_shape::kCylinders) {
    const Eigen::Vector3d a = at(k.link, k.p0), b = at(k.link, k.p1);
    const double steep = (b - a).normalized().z();
    c.table =
        std::min(c.table, std::min(a.z(), b.z()) - k.radius * std::sqrt(std::max(0.0, 1 - steep * steep)));
  }
  for (const auto& k : lite6_shape::kBoxes) {
    for (int corner = 0; corner < 8; ++corner) {
      float x[3];
      for (int i = 0; i < 3; ++i) x[i] = k.centre[i] + (corner >> i & 1 ? k.half[i] : -k.half[i]);
      c.table = std::min(c.table, at(k.link, x).z());
    }
  }
  return c;
}

}  // namespace intabs
