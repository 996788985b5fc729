#include "intabs/perception/reprojection.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>

#include "intabs/core/types.h"

namespace intabs {
namespace {

constexpr double kNearest = 1e-3;  // m; a point nearer than this to the camera's plane counts as behind it
constexpr double kInfinity = std::numeric_limits<double>::infinity();

// The object's six, then six of each uncertain camera.
constexpr int kMaxStates = 6 + 6 * kMaxCameras;
using StateMatrix = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, 0, kMaxStates, kMaxStates>;
using StateVector = Eigen::Matrix<double, Eigen::Dynamic, 1, 0, kMaxStates, 1>;

// Everything that is sought.
struct State {
  Pose X_WO;
  std::array<Pose, kMaxCameras> X_WC;
};

class Problem {
 public:
  Problem(std::span<const PlacedCamera> cameras, std::span<const PointView> points,
          std::span<const Matrix8d> weights)
      : cameras_(cameras), points_(points), weights_(weights) {
    for (size_t c = 0; c < cameras.size(); ++c) {
      first_[c] = -1;
      const bool used = std::any_of(points.begin(), points.end(),
                                    [&](const PointView& p) { return p.camera == static_cast<int>(c); });
      if (!used || !cameras[c].information) continue;
      first_[c] = size_;
      size_ += 6;
    }
  }

  int size() const { return size_; }

  // Sum of squared distances in px, without weights.
  double Distances(const State& x) const {
    double sum = 0;
    for (const PointView& point : points_) {
      const Eigen::Vector3d p_C = x.X_WC[point.camera].Inverse() * (x.X_WO * point.p_O);
      if (!(p_C.z() > kNearest)) return kInfinity;
      sum += (cameras_[point.camera].model->Project(p_C) - point.uv).squaredNorm();
    }
    return sum;
  }

  // Sum of squared weighted residuals; fills the normal equations when asked.
  double Linearise(const State& x, StateMatrix* H, StateVector* g) const {
    const Eigen::Matrix3d R_WO = x.X_WO.q.toRotationMatrix();
    if (H) {
      H->setZero(size_, size_);
      g->setZero(size_);
    }
    double cost = 0;
    const size_t group = weights_.empty() ? 1 : 4;
    for (size_t i = 0; i + group <= points_.size(); i += group) {
      const int c = points_[i].camera;
      const CameraModel& model = *cameras_[c].model;
      const Eigen::Matrix3d R_CW = x.X_WC[c].q.conjugate().toRotationMatrix();
      Eigen::Matrix<double, 8, 6> J, E;  // by the object and by the camera
      Eigen::Matrix<double, 8, 1> r;
      for (size_t k = 0; k < group; ++k) {
        const PointView& point = points_[i + k];
        const Eigen::Vector3d arm = R_WO * point.p_O;
        const Eigen::Vector3d p_C = R_CW * (arm + x.X_WO.p - x.X_WC[c].p);
        if (!(p_C.z() > kNearest)) return kInfinity;
        r.segment<2>(2 * k) = model.Project(p_C) - point.uv;
        if (!H) continue;
        const double iz = 1.0 / p_C.z();
        Eigen::Matrix<double, 2, 3> D;
        D << model.fx * iz, 0, -model.fx * p_C.x() * iz * iz, 0, model.fy * iz, -model.fy * p_C.y() * iz * iz;
        const Eigen::Matrix<double, 2, 3> D_W = D * R_CW;
        J.block<2, 3>(2 * k, 3) = D_W;
        for (int row = 0; row < 2; ++row) {  // d(Exp(w) arm)/dw = -[arm]x; p_C = Exp(-e) p_C
          J.block<1, 3>(2 * k + row, 0) = arm.cross(D_W.row(row).transpose()).transpose();
          E.block<1, 3>(2 * k + row, 0) = D.row(row).transpose().cross(p_C).transpose();
        }
        E.block<2, 3>(2 * k, 3) = -D;
      }
      const int rows = static_cast<int>(2 * group);
      if (!weights_.empty()) {
        const Matrix8d& A = weights_[i / 4];
        r = (A * r).eval();
        if (H) {
          J = (A * J).eval();
          if (first_[c] >= 0) E = (A * E).eval();
        }
      }
      cost += r.head(rows).squaredNorm();
      if (!H) continue;
      H->topLeftCorner<6, 6>().noalias() += J.topRows(rows).transpose() * J.topRows(rows);
      g->head<6>().noalias() += J.topRows(rows).transpose() * r.head(rows);
      if (first_[c] < 0) continue;
      const int at = first_[c];
      H->block<6, 6>(at, at).noalias() += E.topRows(rows).transpose() * E.topRows(rows);
      H->block<6, 6>(0, at).noalias() += J.topRows(rows).transpose() * E.topRows(rows);
      g->segment<6>(at).noalias() += E.topRows(rows).transpose() * r.head(rows);
    }
    for (size_t c = 0; c < cameras_.size(); ++c) {
      if (first_[c] < 0) continue;
      const int at = first_[c];
      const Pose moved = cameras_[c].X_WC.Inverse() * x.X_WC[c];
      Vector6d e;
      e << LogSO3(moved.q), moved.p;
      const Vector6d pull = *cameras_[c].information * e;
      cost += e.dot(pull);
      if (!H) continue;
      H->block<6, 6>(at, at) += *cameras_[c].information;
      g->segment<6>(at) += pull;
      H->block<6, 6>(at, 0) = H->block<6, 6>(0, at).transpose();
    }
    return cost;
  }

  State Moved(const State& x, const StateVector& step) const {
    State out = x;
    out.X_WO = {x.X_WO.p + step.segment<3>(3), (ExpSO3(step.head<3>()) * x.X_WO.q).normalized()};
    for (size_t c = 0; c < cameras_.size(); ++c) {
      if (first_[c] < 0) continue;
      out.X_WC[c].p += x.X_WC[c].q * step.segment<3>(first_[c] + 3);
      out.X_WC[c].q = (x.X_WC[c].q * ExpSO3(step.segment<3>(first_[c]))).normalized();
    }
    return out;
  }

 private:
  std::span<const PlacedCamera> cameras_;
  std::span<const PointView> points_;
  std::span<const Matrix8d> weights_;
  std::array<int, kMaxCameras> first_{};  // of its states; -1: stands where it stands
  int size_ = 6;
};

State Start(std::span<const PlacedCamera> cameras, const Pose& X_WO) {
  State x;
  x.X_WO = X_WO;
  for (size_t c = 0; c < cameras.size(); ++c) x.X_WC[c] = cameras[c].X_WC;
  return x;
}

}  // namespace

std::array<Eigen::Vector3d, 4> TagPoints(double size) {
  const double h = size / 2;
  return {{{-h, h, 0}, {h, h, 0}, {h, -h, 0}, {-h, -h, 0}}};
}

double ReprojectionRms(std::span<const PlacedCamera> cameras, std::span<const PointView> points,
                       const Pose& X_WO) {
  const double sum = Problem(cameras, points, {}).Distances(Start(cameras, X_WO));
  return std::sqrt(sum / static_cast<double>(points.size()));
}

Matrix8d Whitening(const Matrix8d& covariance) {
  return covariance.llt().matrixL().solve(Matrix8d::Identity());
}

PoseFit FitPose(std::span<const PlacedCamera> cameras, std::span<const PointView> points, const Pose& start,
                std::span<const Matrix8d> weights) {
  PoseFit fit;
  fit.X_WO = start;
  if (points.size() < 3 || !start.IsFinite()) return fit;
  const Problem problem(cameras, points, weights);
  State x = Start(cameras, start);
  StateMatrix H, next_H;
  StateVector g, next_g;
  fit.cost = problem.Linearise(x, &H, &g);
  if (!std::isfinite(fit.cost)) return fit;
  double damping = 1e-4;
  for (int i = 0; i < 30; ++i) {
    StateMatrix A = H;
    A.diagonal() *= 1.0 + damping;
    const StateVector step = A.ldlt().solve(-g);
    if (!step.allFinite()) return fit;
    const State next = problem.Moved(x, step);
    const double next_cost = problem.Linearise(next, &next_H, &next_g);
    if (next_cost <= fit.cost) {
      const bool done = step.head<3>().norm() < 1e-8 && step.segment<3>(3).norm() < 1e-9;
      x = next;
      H = next_H;
      g = next_g;
      fit.cost = next_cost;
      if (done) break;
      damping = std::max(damping * 0.1, 1e-9);
    } else {
      if (damping > 1e6) break;
      damping *= 10;
    }
  }
  fit.X_WO = x.X_WO;
  fit.information = H.topLeftCorner<6, 6>();
  if (const int more = problem.size() - 6; more > 0) {
    fit.information -= H.topRightCorner(6, more) *
                       H.bottomRightCorner(more, more).ldlt().solve(H.bottomLeftCorner(more, 6)).eval();
  }
  fit.rms_px = std::sqrt(problem.Distances(x) / static_cast<double>(points.size()));
  fit.ok = fit.X_WO.IsFinite() && std::isfinite(fit.rms_px);
  return fit;
}

}  // namespace intabs
