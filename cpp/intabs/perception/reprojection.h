// Levenberg-Marquardt on corner reprojection errors: the one solver behind tag poses, extrinsics and object
// poses.
#pragma once

#include <array>
#include <span>

#include "intabs/perception/camera_model.h"

namespace intabs {

using TagCorners =
    std::array<Eigen::Vector2d, 4>;  // px, AprilTag's order: bottom left, bottom right, top right, top left
using Matrix6d = Eigen::Matrix<double, 6, 6>;
using Vector6d = Eigen::Matrix<double, 6, 1>;

// The four corners of a tag with black edge `size` [m] in T (x right, y down as printed, z into the tag),
// same order.
std::array<Eigen::Vector3d, 4> TagPoints(double size);

// A camera that stands where it is known to stand.
struct PlacedCamera {
  const CameraModel* model = nullptr;
  Pose X_WC;
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
  // J^T J of the residuals over (rotation vector [rad], p [m]) in W, X_WO = (Exp(w) R, p + dp): the inverse
  // times the variance of a pixel coordinate is the covariance.
  Matrix6d information = Matrix6d::Zero();
};

// Root mean square reprojection distance [px] of a pose; infinite when a point lies behind its camera.
double ReprojectionRms(std::span<const PlacedCamera> cameras, std::span<const PointView> points,
                       const Pose& X_WO);

// The local minimum next to `start`. Allocates nothing.
PoseFit FitPose(std::span<const PlacedCamera> cameras, std::span<const PointView> points, const Pose& start);

}  // namespace intabs
