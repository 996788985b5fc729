// Which of the poses that explain a frame is the true one, told by the motion over many frames.
//
// A flat tag has two poses in one camera, and pictures may be wrong altogether. Each branch of the track is
// one story of which pose was true so far (or none: an outlier), with a filter of constant velocity behind
// it. Its cost is minus the logarithm of its probability: how badly the poses fit their pictures, how
// unlikely the motion between them is, and a price for outliers and for starting afresh. The cheapest branch
// decides, at any moment from all evidence so far, so that a wrong start is put right; the last pose as such
// has no say.
#pragma once

#include <optional>
#include <span>
#include <vector>

#include "intabs/perception/object_solver.h"

namespace intabs {

class PoseTrack {
 public:
  // Of one frame, all relative to the cheapest: the cost of the best story in which hypothesis i is true, and
  // of the best one in which none is.
  struct Evidence {
    std::vector<double> cost;
    double none = 0;
    bool continues = false;  // the cheapest story goes on from earlier frames
    bool empty() const { return cost.empty(); }
  };

  // hypotheses: this frame's, `cost` as in ObjectPose; empty: nothing was seen, which is no evidence. time_s
  // must not go back (Reset() first). What is more than 0.5 s old says nothing of what is seen now.
  Evidence Update(double time_s, std::span<const ObjectPose> hypotheses);

  // The same with all frames in view: a pass backwards besides, the two joined at each frame (two-filter
  // smoothing, Fraser and Potter 1969, over branches). time_s and hypotheses: of all frames, in order.
  static std::vector<Evidence> Revise(std::span<const double> time_s,
                                      std::span<const std::vector<ObjectPose>> hypotheses);

  // Where the cheapest story expects the object; unset without one within the last half second.
  std::optional<Pose> Predicted(double time_s) const;

  void Reset() { branches_.clear(); }

 private:
  using Matrix12d = Eigen::Matrix<double, 12, 12>;
  struct Branch {
    Pose X_WO;
    Vector6d rate;  // (turning [rad/s], velocity [m/s]) in W
    Matrix12d P;    // of (rotation vector, position, turning, velocity)
    double cost = 0;
    int now = -1, before = -1;  // hypotheses that it took: in this frame, in its last one before
    bool anew = false;          // started in this frame
  };

  static Branch Born(const ObjectPose& pose, double cost);
  void Predict(double time_s);
  Evidence Correct(std::span<const ObjectPose> hypotheses);
  static double Junction(const Branch& forward, const Branch& backward);

  std::vector<Branch> branches_;
  double time_s_ = 0;  // of the branches
};

// What Evidence says: the hypothesis to take, -1 for none, and the probability that it is a wrong one.
struct Verdict {
  int hypothesis = -1;
  double p_wrong = 0;
};
Verdict Judge(const PoseTrack::Evidence& evidence);

}  // namespace intabs
