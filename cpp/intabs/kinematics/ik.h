// Inverse kinematics of the Lite 6 for the gripper's tip. Pure; allocates only to say why it refuses. Not for
// the tick.
#pragma once

#include <string>

#include "intabs/kinematics/arm_model.h"

namespace intabs {

enum class IkChoice {
  kNearest,    // least |q - q_seed|
  kBestScore,  // highest score; of equal ones the nearest to q_seed
};

struct IkResult {
  bool ok = false;
  JointVector q = JointVector::Zero();  // valid if ok; within the joint limits [rad]
  double score = 0;                     // ArmScore of q
  std::string why;                      // if not ok: one line
};

// min(distance to the nearest joint limit [rad], 5 x smallest singular value of the tip's Jacobian): how far
// q is from where a motion would get stuck. 0.1 and less is uncomfortable. Negative outside the limits.
double ArmScore(const ArmModel& model, const JointVector& q);

// Closed form over all eight branches of the nominal arm (axes 4, 5, 6 meet in one point) and all whole
// turns, then damped least squares on the arm at hand, whose calibrated joint origins may be millimetres off.
// The answer is checked by forward kinematics: wrong by less than kPositionTolerance and kAngleTolerance, or
// refused.
class IkSolver {
 public:
  static constexpr double kPositionTolerance = 1e-5;  // [m]
  static constexpr double kAngleTolerance = 1e-4;     // [rad]

  explicit IkSolver(const ArmModel& model) : model_(model) {}

  // X_BG: wanted pose of the tip in the base. Along a path give the last answer as q_seed: the branch is
  // kept.
  IkResult Solve(const Pose& X_BG, const JointVector& q_seed, IkChoice choice = IkChoice::kNearest) const;

  const ArmModel& model() const { return model_; }

 private:
  ArmModel model_;
};

}  // namespace intabs
