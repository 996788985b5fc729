#include "intabs/perception/reprojection.h"

#include <Eigen/Cholesky>
#include <cmath>
#include <limits>

namespace intabs {
namespace {

constexpr double kNearest = 1e-3;  // m; a point nearer than this to the camera's plane counts as behind it
constexpr double kInfinity = std::numeric_limits<double>::infinity();

// Sum of squared residuals [px^2]; fills the normal equations when asked.
double Linearise(std::span<const PlacedCamera> cameras, std::span<const PointView> points, const Pose& X_WO,
                 Matrix6d* H, Vector6d* g) {
  const Eigen::Matrix3d R_WO = X_WO.q.toRotationMatrix();
  if (H) {
    H->setZero();
    g->setZero();
  }
  double cost = 0;
  for (const PointView& point : points) {
    const PlacedCamera& camera = cameras[point.camera];
    const CameraModel& model = *camera.model;
    const Eigen::Vector3d arm = R_WO * point.p_O;
    const Eigen::Matrix3d R_CW = camera.X_WC.q.conjugate().toRotationMatrix();
    const Eigen::Vector3d p_C = R_CW * (arm + X_WO.p - camera.X_WC.p);
    if (!(p_C.z() > kNearest)) return kInfinity;
    const Eigen::Vector2d r = model.Project(p_C) - point.uv;
    cost += r.squaredNorm();
    if (!H) continue;
    const double iz = 1.0 / p_C.z();
    Eigen::Matrix<double, 2, 3> D;
    D << model.fx * iz, 0, -model.fx * p_C.x() * iz * iz, 0, model.fy * iz, -model.fy * p_C.y() * iz * iz;
    Eigen::Matrix<double, 2, 6> J;
    J.rightCols<3>() = D * R_CW;
    for (int i = 0; i < 2; ++i) {  // d(Exp(w) arm)/dw = -[arm]x
      J.row(i).head<3>() = arm.cross(J.row(i).tail<3>().transpose()).transpose();
    }
    H->noalias() += J.transpose() * J;
    g->noalias() += J.transpose() * r;
  }
  return cost;
}

}  // namespace

std::array<Eigen::Vector3d, 4> TagPoints(double size) {
  const double h = size / 2;
  return {{{-h, h, 0}, {h, h, 0}, {h, -h, 0}, {-h, -h, 0}}};
}

double ReprojectionRms(std::span<const PlacedCamera> cameras, std::span<const PointView> points,
                       const Pose& X_WO) {
  return std::sqrt(Linearise(cameras, points, X_WO, nullptr, nullptr) / points.size());
}

PoseFit FitPose(std::span<const PlacedCamera> cameras, std::span<const PointView> points, const Pose& start) {
  PoseFit fit;
  fit.X_WO = start;
  if (points.size() < 3 || !start.IsFinite()) return fit;
  Vector6d g;
  double cost = Linearise(cameras, points, fit.X_WO, &fit.information, &g);
  if (!std::isfinite(cost)) return fit;
  double damping = 1e-4;
  for (int i = 0; i < 30; ++i) {
    Matrix6d A = fit.information;
    A.diagonal() *= 1.0 + damping;
    const Vector6d step = A.ldlt().solve(-g);
    if (!step.allFinite()) return fit;
    const Pose next{fit.X_WO.p + step.tail<3>(), (ExpSO3(step.head<3>()) * fit.X_WO.q).normalized()};
    Matrix6d H;
    Vector6d next_g;
    const double next_cost = Linearise(cameras, points, next, &H, &next_g);
    if (next_cost <= cost) {
      const bool done = step.head<3>().norm() < 1e-8 && step.tail<3>().norm() < 1e-9;
      fit.X_WO = next;
      fit.information = H;
      g = next_g;
      cost = next_cost;
      if (done) break;
      damping = std::max(damping * 0.1, 1e-9);
    } else {
      if (damping > 1e6) break;
      damping *= 10;
    }
  }
  fit.rms_px = std::sqrt(cost / points.size());
  fit.ok = fit.X_WO.IsFinite();
  return fit;
}

}  // namespace intabs
