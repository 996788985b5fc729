// Levenberg-Marquardt on corner reprojection errors: the one solver behind tag poses, extrinsics and object
// poses.
#pragma once

#include <array>
#include <optional>
#include <span>

#include "intabs/perception/camera_model.h"

namespace intabs {

using TagCorners =
    std::array<Eigen::Vector2d, 4>;  // px, AprilTag's order: bottom left, bottom right, top right, top left
using Matrix6d = Eigen::Matrix<double, 6, 6>;
using Matrix8d = Eigen::Matrix<double, 8, 8>;
using Vector6d = Eigen::Matrix<double, 6, 1>;

// The four corners of a tag with black edge `size` [m] in T (x right, y down as printed, z into the tag),
// same order.
std::array<Eigen::Vector3d, 4> TagPoints(double size);

// A camera and where it stands.
struct PlacedCamera {
  const CameraModel* model = nullptr;
  Pose X_WC;
  // Inverse covariance of a small motion e = (rotation vector [rad], position [m]) on the right, X_WC Exp(e).
  // Unset: the camera stands exactly there.
  std::optional<Matrix6d> information{};
};

// A point of a rigid body that a camera sees.
struct PointView {
  Eigen::Vector3d p_O;
  Eigen::Vector2d uv;  // px
  int camera = 0;      // index into the cameras
};

struct PoseFit {
  bool ok = false;  // false: fewer than 3 points, not finite, or a point behind its camera
  Pose X_WO;
  double rms_px = 0;  // root mean square distance over the points
  // Sum of the squared weighted residuals, with what it cost to move uncertain cameras.
  double cost = 0;
  // Of (rotation vector [rad], p [m]) in W, X_WO = (Exp(w) R, p + dp), with the cameras' places integrated
  // out. With weights: the inverse covariance; without: that times the variance of a pixel coordinate.
  Matrix6d information = Matrix6d::Zero();
};

// Root mean square reprojection distance [px] of a pose; infinite when a point lies behind its camera.
double ReprojectionRms(std::span<const PlacedCamera> cameras, std::span<const PointView> points,
                       const Pose& X_WO);

// A with A^T A = covariance^-1.
Matrix8d Whitening(const Matrix8d& covariance);

// The local minimum next to `start`, together with the places of the uncertain cameras. weights: one a group
// of four points of one camera (a tag's corners), applied to the stacked residuals (u0 v0 u1 ...); empty:
// ones. At most kMaxCameras cameras. Allocates nothing.
PoseFit FitPose(std::span<const PlacedCamera> cameras, std::span<const PointView> points, const Pose& start,
                std::span<const Matrix8d> weights = {});

}  // namespace intabs
