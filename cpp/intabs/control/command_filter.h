// From late, irregular joint targets to a smooth 250 Hz reference within the arm's limits.
#pragma once

#include "intabs/control/axis.h"
#include "intabs/control/stop_guard.h"
#include "intabs/core/types.h"
#include "intabs/kinematics/arm_model.h"

namespace intabs {

// Defaults: the Lite 6, with the speed its vendor's own drivers command (the hard limit is 3.14 rad/s).
struct ArmLimits {
  JointVector q_min = ArmModel::Lite6().q_min();      // [rad]
  JointVector q_max = ArmModel::Lite6().q_max();      // [rad]
  JointVector dq_max = JointVector::Constant(2.14);   // [rad/s]
  JointVector ddq_max = JointVector::Constant(20);    // [rad/s^2]
  JointVector dddq_max = JointVector::Constant(500);  // [rad/s^3]
  double tcp_speed_max = 0.5;  // of the gripper tip [m/s], aimed at; space.tip_speed_guard is never exceeded
  ArmSpace space;
};

// Position, velocity and acceleration of the reference.
// Two stages. The *path point* walks on a straight line to the target, evenly over the time until the next
// target is due, no faster than joint and tip may move. The *reference* follows it joint by joint through a
// third-order lag, or as fast as jerk and acceleration allow, and never so that its stop would end beyond the
// path point: so a target that is held is reached without overshoot and then exactly.
// A step is taken only if the stop that could follow it is free (StopGuard), otherwise that stop is begun,
// which the step before has shown to be free: whatever the targets, the arm can always stop, and never leaves
// position, speed, acceleration, jerk and tip speed limits, its workspace, nor touches itself or the table.
// Fixed memory, noexcept, real-time safe, deterministic.
class CommandFilter {
 public:
  // `limits`: positive, q_min < q_max.
  CommandFilter(const ArmLimits& limits, const ArmModel& model) noexcept;

  // At rest at `q`; from outside the limits, or too near to something, it may only move away from there.
  void Reset(const JointVector& q) noexcept;

  // `q_target` (finite) is where the arm is meant to be `ticks` >= 1 driver ticks from now, when the next
  // target is due. A target beyond a joint's limit is approached as far as the limit.
  void SetTarget(const JointVector& q_target, int ticks) noexcept;

  // One driver tick towards the target, no joint faster than `dq_max` (> 0) but while it brakes.
  void Follow(const JointVector& dq_max) noexcept;

  // One driver tick of the fastest stop that keeps the jerk limit. The target is forgotten.
  void Brake() noexcept;

  // The same for a declared stop (ESTOP, fault): each joint brakes as hard as its acceleration limit allows
  // at once, whatever the jerk, if that way is free too. Once begun it goes on to rest, also in Follow.
  void Halt() noexcept;

  bool at_rest() const noexcept { return at_rest_; }
  const JointVector& position() const noexcept { return q_; }
  const JointVector& velocity() const noexcept { return dq_; }
  const JointVector& acceleration() const noexcept { return ddq_; }
  // Whether the last tick was one of a declared stop that broke the jerk limit.
  bool halted() const noexcept { return halted_; }
  // Whether the last Follow was held back by the guard.
  bool blocked() const noexcept { return blocked_; }
  const StopGuard& guard() const noexcept { return guard_; }
  const ArmLimits& limits() const noexcept { return limits_; }
  const ArmModel& model() const noexcept { return model_; }

 private:
  void AdvancePathPoint(const JointVector& dq_max) noexcept;
  void HaltStep() noexcept;
  void Adopt(const AxisStates& next) noexcept;

  ArmLimits limits_;
  ArmModel model_;
  std::array<AxisLimits, kNumJoints> axes_;
  StopGuard guard_;

  AxisStates state_{};
  JointVector low_, high_;  // position limits, wider while the arm is outside of them
  JointVector target_ = JointVector::Zero(), path_ = JointVector::Zero();
  int ticks_left_ = 1;  // on the path to the target
  bool blocked_ = false;
  bool halting_ = false, halt_decided_ = false, halted_ = false;
  bool at_rest_ = true;
  JointVector q_ = JointVector::Zero(), dq_ = JointVector::Zero(),
              ddq_ = JointVector::Zero();  // state_ by kind
};

}  // namespace intabs
