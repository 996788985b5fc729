// What stands between a policy's commands and the arm: sessions, command filter, watchdog and safety states.
// The same object runs in the plant, in the driver of the real arm and in in-process rollouts.
//
//   Idle --command--> Aligning --near--> Tracking --stale, kHold, link--> Slowing --at rest--> Holding
//                        ^------------------------- command of the session -|---------------------|
//   Holding with nothing commanded, or no link, for 2 s: Fault. Fail() leads to Fault from any state but
//   Stopped, ESTOP from any state to Stopped; RESET from both to Holding (by way of Slowing).
//   What leads where, and which test shows it: README.md.
#pragma once

#include <array>
#include <cstdint>

#include "intabs/control/command_filter.h"
#include "intabs/control/tick_record.h"
#include "intabs/core/types.h"

namespace intabs {

struct ArmSafety {
  double align_within = 0.1;  // a first target farther than this [rad, any joint] is approached slowly ...
  double align_dq = 0.35;     // ... at this speed [rad/s], until it is as near
  // Two ticks farther apart than this, in motion: Fault::kOverrun. 0: not watched (a simulated arm waits).
  int64_t stall_us = 0;
};

// Real-time safe: fixed memory, no call throws or blocks. One thread. Times are of one clock that never goes
// back.
class ArmController {
 public:
  static constexpr int64_t kFaultAfterUs = 2000000;    // held without a command since it went stale
  static constexpr int64_t kMaxLifetimeUs = 10000000;  // a longer one would switch the watchdog off

  ArmController(const ArmLimits& limits, const ArmModel& model, const ArmSafety& safety = {}) noexcept;

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

  // The arm cannot go on: brakes and is in Fault at once, latched until ResetFault. The first fault is kept;
  // an ESTOP outranks it.
  void Fail(Fault fault) noexcept;

  // Whether the arm answers and its readings are fresh; true until told otherwise. While it is not, the
  // reference slows down and holds, commands are heard but move nothing, and after 2 s it is a fault
  // (kStaleStatus).
  void SetLink(bool ok) noexcept { link_ok_ = ok; }

  // The reference starts anew from the measured pose (finite): the arm had stopped on its own. Only at rest
  // and not in command of the motion (Idle, Holding, Fault, Stopped); otherwise false and nothing happens.
  bool Rebase(const JointVector& q_measured) noexcept;

  // From Fault or Stopped to Holding; only `session` (> 0) may command next. Until it has, another RESET may
  // name another one. Does nothing in other states.
  void ResetFault(int64_t session) noexcept;

  // Once per driver period (4 ms): watchdog, then one step of the filter.
  void Tick(int64_t now_us) noexcept;

  // Whether a session is in command: then nobody may start the plant over.
  bool Busy(int64_t now_us) const noexcept;

  // The reference for the servos: [rad], [rad/s], [rad/s^2].
  const JointVector& q_ref() const noexcept { return filter_.position(); }
  const JointVector& dq_ref() const noexcept { return filter_.velocity(); }
  const JointVector& ddq_ref() const noexcept { return filter_.acceleration(); }
  bool gripper_closed() const noexcept { return gripper_closed_; }
  ArmState state() const noexcept { return state_; }
  const CommandFilter& filter() const noexcept { return filter_; }

  // Fills session, q_commanded, gripper_closed, mode, state, fault, last_command_seq, refused.
  void FillStatus(ArmStatus& status) const noexcept;
  // Fills all but what was measured.
  void FillRecord(TickRecord& record) const noexcept;

 private:
  bool CommandIsValid(int64_t now_us) const noexcept {
    return lifetime_us_ > 0 && now_us - received_us_ <= lifetime_us_;
  }

  // Ticks until the next command of the running stream is due.
  int TicksToNext(int64_t now_us, int64_t since_last_us) noexcept;
  bool Moving() const noexcept { return state_ == ArmState::kTracking || state_ == ArmState::kAligning; }
  bool Near() const noexcept;
  void Stop(ArmState state, Fault fault) noexcept;

  CommandFilter filter_;
  ArmSafety safety_;
  ArmState state_ = ArmState::kIdle;
  Fault fault_ = Fault::kNone;
  ArmMode mode_ = ArmMode::kHold;
  bool gripper_closed_ = false;

  int64_t session_ = 0;   // obeyed or last obeyed, 0: none yet
  int64_t reserved_ = 0;  // the only one that may command next, after a RESET; 0: any
  int64_t last_seq_ = 0;
  bool has_seq_ = false;  // last_seq_ is of session_

  int64_t period_us_ = kPolicyPeriodUs;  // of the session's commands, as they came lately
  int64_t due_us_ = 0;                   // when the next one is expected
  JointVector q_target_ = JointVector::Zero();
  JointVector dq_max_ = JointVector::Zero();
  int64_t received_us_ = 0;
  int64_t lifetime_us_ = 0;  // 0: no command is valid
  bool stale_ = false;       // slows or holds because commands stopped coming
  bool link_ok_ = true;
  bool unlinked_ = false;  // holds without a link, since then:
  int64_t unlinked_since_us_ = 0;
  int64_t held_since_us_ = 0;
  int64_t last_tick_us_ = 0;

  std::array<int32_t, kNumRefusals> refused_{};
};

}  // namespace intabs
