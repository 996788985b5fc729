// Views of tags with exactly known poses: AprilTag's own pictures warped into a cluttered image,
// area-sampled, blurred, with noise. Made of OpenCV alone, independent of the plant's renderer.
#pragma once

#include <map>
#include <opencv2/core.hpp>

#include "intabs/perception/camera_model.h"
#include "intabs/perception/refine.h"

namespace intabs::test {

struct PlacedTag {
  Pose X_WT;
  double size = 0;  // black edge [m]
};
using Scene = std::map<int, PlacedTag>;  // by id

struct Quality {
  double blur_px = 0.8;
  double noise = 3;  // grey levels
};

TagPattern Pattern(int id);  // as AprilTag draws it

// f 610 at 640 x 480, as the plant's cameras.
CameraModel VgaCamera(const std::string& name, const Pose& X_WC);

// An optical frame at `eye` that looks at `target`, image up along +z of W as far as may be.
Pose LookAt(const Eigen::Vector3d& eye, const Eigen::Vector3d& target);

cv::Mat View(const CameraModel& camera, const Scene& scene, uint64_t seed, const Quality& quality = {});

}  // namespace intabs::test
