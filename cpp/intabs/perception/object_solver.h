// One pose of a rigid object from all its tags in all cameras: the least squares over the corners, started
// from every hypothesis of every tag. The planar ambiguity is settled by the total cost, never by the last
// pose.
#pragma once

#include <vector>

#include "intabs/perception/tag_pose.h"

namespace intabs {

// One tag of the object, seen by one camera.
struct TagView {
  int camera = 0;   // index into the placed cameras
  double size = 0;  // black edge [m]
  Pose X_OT;
  TagCorners corners;  // px
  TagPose hypotheses;  // SolveTag's
};

struct ObjectFit {
  bool ok = false;     // a minimum was found; the fields below mean something
  bool valid = false;  // ... and is to be believed
  Pose X_WO;
  double rms_px = 0;  // over all corners used
  double ambiguity =
      0;  // rms of the best minimum / that of the next best that is turned by over 10 deg; 0: none
  Matrix6d covariance = Matrix6d::Zero();  // (rotation vector, position) in W, as in core/types.h
  uint8_t cameras = 0;                     // bit i: camera i contributed
  int tags = 0;                            // views used
};

struct ObjectSolverLimits {
  double corner_sigma_px = 0.05;  // standard deviation of a corner coordinate, for the covariance
  double max_rms_px = 1.0;        // more: the views contradict each other
  double max_ambiguity = 0.6;     // with one tag in one camera
};

// A view that contradicts the others is dropped as long as its camera keeps another one; two cameras that
// contradict each other give an invalid fit, for nobody can say which is right.
ObjectFit SolveObject(std::span<const PlacedCamera> cameras, std::vector<TagView> views,
                      const ObjectSolverLimits& limits);

// Upper triangle, row by row (core/types.h).
std::array<float, 21> PackCovariance(const Matrix6d& covariance);

}  // namespace intabs
