// What stands between a policy's commands and the arm: sessions, command filter, watchdog and safety states.
// The same object runs in the plant, in the driver of the real arm and in in-process rollouts.
//
//   Idle --command--> Tracking --stale or kHold--> Slowing --at rest--> Holding --stale for 2 s--> Fault
//                        ^----- command of the session ---|----------------|
//   ESTOP leads from any state to Stopped; RESET from Fault and Stopped to Holding (by way of Slowing).
#pragma once

#include <array>
#include <cstdint>

#include "intabs/control/joint_filter.h"
#include "intabs/core/types.h"

namespace intabs {

// Real-time safe: fixed memory, no call throws or blocks. One thread. Times are of one clock that never goes
// back.
class ArmController {
 public:
  static constexpr int64_t kFaultAfterUs = 2000000;    // held without a command since it went stale
  static constexpr int64_t kMaxLifetimeUs = 10000000;  // a longer one would switch the watchdog off

  ArmController(const ArmLimits& limits, const ArmModel& model) noexcept;

  // Holds this pose; idle, no session, nothing counted. `q_measured` finite.
  void Reset(const JointVector& q_measured, int64_t now_us) noexcept;

  // Takes a command, or refuses and counts it; a refused one changes nothing else.
  //  - Session: a new one is adopted in Idle, or in Holding while no command of another session is valid.
  //    After a RESET only the session it named. In Fault and Stopped none.
  //  - Mode, numbers, ranges. q_target within the joint limits; dq_max above the arm's limit is cut to it.
  //  - seq: higher than any before in the session.
  // A command with mode kHold slows down and holds without a fault to come, as long as nobody commands
  // otherwise; it leaves the gripper alone.
  Refusal Accept(const ArmCommand& command, int64_t now_us) noexcept;
  // What Accept would answer.
  Refusal Check(const ArmCommand& command, int64_t now_us) const noexcept;
  // For a command that was refused before it came here; kAccepted stands for an undecodable one.
  void Count(Refusal refusal) noexcept { ++refused_[static_cast<int>(refusal)]; }
  void CountUndecodable() noexcept { Count(Refusal::kAccepted); }

  // Brakes within the limits and holds, latched until ResetFault.
  void Estop() noexcept;

  // From Fault or Stopped to Holding; only `session` (> 0) may command next. Until it has, another RESET may
  // name another one. Does nothing in other states.
  void ResetFault(int64_t session) noexcept;

  // Once per driver period (4 ms): watchdog, then one step of the filter.
  void Tick(int64_t now_us) noexcept;

  // Whether a session is in command: then nobody may start the plant over.
  bool Busy(int64_t now_us) const noexcept;

  // The reference for the servos: [rad], [rad/s].
  const JointVector& q_ref() const noexcept { return filter_.position(); }
  const JointVector& dq_ref() const noexcept { return filter_.velocity(); }
  bool gripper_closed() const noexcept { return gripper_closed_; }
  ArmState state() const noexcept { return state_; }

  // Fills session, q_commanded, gripper_closed, mode, state, fault, last_command_seq, refused.
  void FillStatus(ArmStatus& status) const noexcept;

 private:
  bool CommandIsValid(int64_t now_us) const noexcept {
    return lifetime_us_ > 0 && now_us - received_us_ <= lifetime_us_;
  }

  JointFilter filter_;
  ArmState state_ = ArmState::kIdle;
  Fault fault_ = Fault::kNone;
  ArmMode mode_ = ArmMode::kHold;
  bool gripper_closed_ = false;

  int64_t session_ = 0;   // obeyed or last obeyed, 0: none yet
  int64_t reserved_ = 0;  // the only one that may command next, after a RESET; 0: any
  int64_t last_seq_ = 0;
  bool has_seq_ = false;  // last_seq_ is of session_

  JointVector q_target_ = JointVector::Zero();
  JointVector dq_max_ = JointVector::Zero();
  int64_t received_us_ = 0;
  int64_t lifetime_us_ = 0;  // 0: no command is valid
  bool stale_ = false;       // slows or holds because commands stopped coming
  int64_t held_since_us_ = 0;

  std::array<int32_t, kNumRefusals> refused_{};
};

}  // namespace intabs
