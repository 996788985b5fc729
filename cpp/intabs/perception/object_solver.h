// One pose of a rigid object from all its tags in all cameras: the least squares over the corners, started
// from every hypothesis of every tag. The planar ambiguity is settled by the total cost, never by the last
// pose.
#pragma once

#include <cmath>
#include <vector>

#include "intabs/perception/tag_pose.h"

namespace intabs {

// One tag of the object, seen by one camera.
struct TagView {
  int camera = 0;   // index into the placed cameras
  double size = 0;  // black edge [m]
  Pose X_OT;
  TagCorners corners;   // px
  TagPose hypotheses;   // SolveTag's
  Matrix8d covariance;  // of the corners [px^2]
};

// A minimum of the cost.
struct ObjectPose {
  Pose X_WO;
  Matrix6d covariance = Matrix6d::Zero();  // (rotation vector, position) in W, as in core/types.h
  double cost = 0;  // half the sum of the squared weighted residuals: minus the logarithm of the likelihood
  uint8_t cameras = 0;  // bit i: camera i contributed
};

struct ObjectFit {
  bool ok = false;     // a minimum was found; the fields below mean something
  bool valid = false;  // ... and is to be believed, as far as one frame can tell
  // The best minimum, and the next best that is turned by over 10 deg from it (one at most). Where the
  // cameras contradict each other: those of each camera alone, for whoever knows more (PoseTrack) to choose.
  std::vector<ObjectPose> minima;
  double rms_px = 0;     // of the best of all cameras together, over all corners used
  double ambiguity = 0;  // ... / that of the second; 0: there is none
  double p_wrong = 0;    // probability that the second one is the true one, as far as this frame can tell
  int tags = 0;          // views used
};

struct ObjectSolverLimits {
  double corner_sigma_px =
      0;                    // standard deviation of a corner coordinate, on top of the views' own covariance
  double max_rms_px = 1.0;  // more: the views contradict each other
  double max_wrong = 0.01;  // larger p_wrong: not valid
};

// What is known of a pose when `chosen` is one of two minima and the other is true with probability p_other:
// the covariance about `chosen`.
Matrix6d CovarianceOfChoice(const ObjectPose& chosen, const ObjectPose& other, double p_other);

// The probability that a pose of this cost is the true one, where the other one is the only alternative.
inline double Probability(double cost, double other) { return 1 / (1 + std::exp(cost - other)); }

// A view that contradicts the others is dropped as long as its camera keeps another one; two cameras that
// contradict each other give an invalid fit, for one frame cannot say which is right.
ObjectFit SolveObject(std::span<const PlacedCamera> cameras, std::vector<TagView> views,
                      const ObjectSolverLimits& limits);

// Upper triangle, row by row (core/types.h).
std::array<float, 21> PackCovariance(const Matrix6d& covariance);

}  // namespace intabs
