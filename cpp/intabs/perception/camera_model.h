// Pinhole camera with OpenCV's lens distortion.
//
// Two kinds of pixels: those of the picture, and ideal ones, where the same camera without distortion would
// have put the point. All solving is done in ideal ones: Undistort() first what was found in a picture.
#pragma once

#include <algorithm>
#include <array>
#include <optional>
#include <string>

#include "intabs/core/types.h"

namespace intabs {

struct CameraModel {
  std::string name;
  int width = 0, height = 0;           // px
  double fx = 0, fy = 0;               // px
  double cx = 0, cy = 0;               // px; the centre of the top left pixel is (0, 0) (OpenCV's convention)
  std::array<double, 5> distortion{};  // k1 k2 p1 p2 k3 (OpenCV's)
  std::optional<Pose> X_WC;            // optical frame in W; unset: found from the ground tag
  std::string source;                  // where its frames come from; empty: the plant's ring

  // p_C in the optical frame (z forward) to ideal pixels; meaningless for p_C.z() <= 0.
  Eigen::Vector2d Project(const Eigen::Vector3d& p_C) const {
    return {fx * p_C.x() / p_C.z() + cx, fy * p_C.y() / p_C.z() + cy};
  }

  bool distorted() const {
    return std::any_of(distortion.begin(), distortion.end(), [](double k) { return k != 0; });
  }

  // Ideal pixel -> pixel of the picture. What lies over half a picture outside stays where it is, for there
  // the polynomials mean nothing.
  Eigen::Vector2d Distort(const Eigen::Vector2d& ideal) const;

  // Pixel of the picture -> ideal pixel, to 1e-6 px. Without distortion both are the identity, bit for bit.
  Eigen::Vector2d Undistort(const Eigen::Vector2d& uv) const;
};

}  // namespace intabs
