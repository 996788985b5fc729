// Pose of one tag from one camera. A plane seen from afar has two poses that explain its corners nearly alike
// (the normal mirrored about the line of sight); both are kept, for whoever knows more to choose.
#pragma once

#include "intabs/perception/reprojection.h"

namespace intabs {

struct TagPose {
  bool ok = false;           // false: no finite pose explains the corners (degenerate view)
  std::array<Pose, 2> X_CT;  // better one first; equal when only one minimum exists
  std::array<double, 2> reprojection_px{};
  double ambiguity = 0;  // reprojection_px[0] / reprojection_px[1]: 1 says nothing, 0 is certain
};

// `size`: the black edge [m]. Start: IPPE (Collins and Bartoli, IJCV 2014; OpenCV's SOLVEPNP_IPPE_SQUARE),
// both of its answers refined by FitPose. An answer that is not finite is replaced by the other one's mirror
// image.
TagPose SolveTag(const CameraModel& camera, double size, const TagCorners& corners);

}  // namespace intabs
