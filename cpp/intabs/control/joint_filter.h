// From late, irregular joint targets to a smooth 250 Hz reference within the arm's limits.
#pragma once

#include "intabs/core/types.h"
#include "intabs/kinematics/arm_model.h"

namespace intabs {

// Defaults: the Lite 6, with the speed its vendor's own drivers command (the hard limit is 3.14 rad/s).
struct ArmLimits {
  JointVector q_min = ArmModel::Lite6().q_min();     // [rad]
  JointVector q_max = ArmModel::Lite6().q_max();     // [rad]
  JointVector dq_max = JointVector::Constant(2.14);  // [rad/s]
  JointVector ddq_max = JointVector::Constant(20);   // [rad/s^2]
  double tcp_speed_max = 0.5;  // of the gripper tip [m/s]; the controller's guard is at 0.6
};

// Position and velocity of the reference. Every step keeps joint positions, speeds and accelerations within
// the limits, whatever the targets; a held target is reached without overshoot and then exactly. The TCP
// keeps its speed limit too, but where only breaking the acceleration limit could keep it (joints whose
// motions cancelled each other brake at different times): acceleration rules then. Fixed memory, noexcept,
// real-time safe.
class JointFilter {
 public:
  // `limits`: positive, q_min < q_max.
  JointFilter(const ArmLimits& limits, const ArmModel& model) noexcept : limits_(limits), model_(model) {}

  // At rest at `q`; from outside the position limits it may only move inward.
  void Reset(const JointVector& q) noexcept;

  // One driver tick towards `q_target` (finite), no joint faster than `dq_max` but while it brakes. A target
  // beyond a joint's limit is approached as far as the limit.
  void Follow(const JointVector& q_target, const JointVector& dq_max) noexcept;

  // One driver tick of braking, each joint as hard as it may.
  void Brake() noexcept;

  bool at_rest() const noexcept { return v_.isZero(0); }
  const JointVector& position() const noexcept { return x_; }
  const JointVector& velocity() const noexcept { return v_; }
  const ArmLimits& limits() const noexcept { return limits_; }
  const ArmModel& model() const noexcept { return model_; }

 private:
  // Goes to the velocity `wanted` as far as acceleration, joint and TCP limits let it.
  void Step(const JointVector& wanted) noexcept;

  ArmLimits limits_;
  ArmModel model_;
  JointVector x_ = JointVector::Zero();
  JointVector v_ = JointVector::Zero();
};

// The highest speed [rad/s] from which a joint that moves in steps of `dt` [s], each with the speed at its
// end, and brakes by at most `a` [rad/s^2] still stops within `distance` [rad], this step included.
double BrakingSpeed(double distance, double a, double dt) noexcept;

}  // namespace intabs
