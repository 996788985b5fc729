// Pinhole camera without distortion.
#pragma once

#include <optional>
#include <string>

#include "intabs/core/types.h"

namespace intabs {

struct CameraModel {
  std::string name;
  int width = 0, height = 0;  // px
  double fx = 0, fy = 0;      // px
  double cx = 0, cy = 0;      // px; the centre of the top left pixel is (0, 0) (OpenCV's convention)
  std::optional<Pose> X_WC;   // optical frame in W; unset: found from the ground tag

  // p_C in the optical frame (z forward) to pixels; meaningless for p_C.z() <= 0.
  Eigen::Vector2d Project(const Eigen::Vector3d& p_C) const {
    return {fx * p_C.x() / p_C.z() + cx, fy * p_C.y() / p_C.z() + cy};
  }
};

}  // namespace intabs
