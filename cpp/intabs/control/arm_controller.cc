#include "intabs/control/arm_controller.h"

#include <algorithm>

namespace intabs {

ArmController::ArmController(const ArmLimits& limits, const ArmModel& model, const ArmSafety& safety) noexcept
    : filter_(limits, model), safety_(safety) {}

void ArmController::Reset(const JointVector& q_measured, int64_t now_us) noexcept {
  *this = ArmController(filter_.limits(), filter_.model(), safety_);
  filter_.Reset(q_measured);
  last_tick_us_ = now_us;
}

Refusal ArmController::Check(const ArmCommand& c, int64_t now_us) const noexcept {
  const bool same_session = c.session == session_ && session_ != 0;
  bool may_command = false;
  switch (state_) {
    case ArmState::kIdle:
      may_command = true;
      break;
    case ArmState::kAligning:
    case ArmState::kTracking:
    case ArmState::kSlowing:
      may_command = same_session;
      break;
    case ArmState::kHolding:
      may_command = same_session || !CommandIsValid(now_us);
      break;
    case ArmState::kFault:
    case ArmState::kStopped:
      break;
  }
  if (reserved_ != 0 && c.session != reserved_) may_command = false;
  if (!may_command || c.session <= 0) return Refusal::kForeignSession;
  if (c.mode != ArmMode::kHold && c.mode != ArmMode::kServo) return Refusal::kUnknownMode;
  if (!c.q_target.allFinite() || !c.dq_max.allFinite()) return Refusal::kNotFinite;
  const ArmLimits& limits = filter_.limits();
  if ((c.q_target.array() < limits.q_min.array()).any() ||
      (c.q_target.array() > limits.q_max.array()).any() || (c.dq_max.array() <= 0).any() ||
      c.lifetime_us <= 0 || c.lifetime_us > kMaxLifetimeUs) {
    return Refusal::kOutOfRange;
  }
  if (same_session && has_seq_ && c.seq <= last_seq_) return Refusal::kOldSequence;
  return Refusal::kAccepted;
}

Refusal ArmController::Accept(const ArmCommand& c, int64_t now_us) noexcept {
  const Refusal refusal = Check(c, now_us);
  if (refusal != Refusal::kAccepted) {
    Count(refusal);
    return refusal;
  }
  const int ticks = TicksToNext(now_us, c.session == session_ ? now_us - received_us_ : INT64_MAX);
  session_ = c.session;
  reserved_ = 0;
  last_seq_ = c.seq;
  has_seq_ = true;
  received_us_ = now_us;
  lifetime_us_ = c.lifetime_us;
  stale_ = false;
  mode_ = c.mode;
  if (c.mode == ArmMode::kServo && link_ok_) {
    q_target_ = c.q_target;
    filter_.SetTarget(q_target_, ticks);
    dq_max_ = c.dq_max.cwiseMin(filter_.limits().dq_max);
    gripper_closed_ = c.gripper_closed;
    if (!Moving()) state_ = ArmState::kAligning;
    if (Near()) state_ = ArmState::kTracking;
  } else if (state_ != ArmState::kHolding) {
    state_ = ArmState::kSlowing;
  }
  return Refusal::kAccepted;
}

// Period and phase of the stream, a fifth corrected by each command: one that comes late leaves less time to
// the next one.
int ArmController::TicksToNext(int64_t now_us, int64_t since_last_us) noexcept {
  constexpr int64_t kPauseUs = 100000;  // longer is no period
  if (since_last_us > kPauseUs) {
    period_us_ = kPolicyPeriodUs;
    due_us_ = now_us + period_us_;
  } else if (2 * since_last_us < period_us_ || since_last_us > 2 * period_us_) {
    period_us_ = std::max(since_last_us, kDriverPeriodUs);
    due_us_ = now_us + period_us_;
  } else {
    period_us_ += (since_last_us - period_us_) / 5;
    due_us_ += (now_us - due_us_) / 5 + period_us_;
    due_us_ = std::clamp(due_us_, now_us + kDriverPeriodUs, now_us + 2 * period_us_);
  }
  return static_cast<int>((due_us_ - now_us + kDriverPeriodUs / 2) / kDriverPeriodUs);
}

bool ArmController::Near() const noexcept {
  return (q_target_ - filter_.position()).cwiseAbs().maxCoeff() <= safety_.align_within;
}

void ArmController::Estop() noexcept { Stop(ArmState::kStopped, Fault::kEstop); }

void ArmController::Fail(Fault fault) noexcept {
  if (state_ != ArmState::kFault && state_ != ArmState::kStopped) Stop(ArmState::kFault, fault);
}

void ArmController::Stop(ArmState state, Fault fault) noexcept {
  state_ = state;
  fault_ = fault;
  mode_ = ArmMode::kHold;
  lifetime_us_ = 0;
  stale_ = unlinked_ = false;
}

bool ArmController::Rebase(const JointVector& q_measured) noexcept {
  if (Moving() || state_ == ArmState::kSlowing || !filter_.at_rest()) return false;
  filter_.Reset(q_measured);
  return true;
}

void ArmController::ResetFault(int64_t session) noexcept {
  if (session <= 0) return;
  const bool unclaimed = reserved_ != 0;
  if (state_ != ArmState::kFault && state_ != ArmState::kStopped && !unclaimed) return;
  if (session != session_) {
    has_seq_ = false;
    last_seq_ = 0;
  }
  session_ = session;
  reserved_ = session;
  fault_ = Fault::kNone;
  stale_ = false;
  if (state_ == ArmState::kFault || state_ == ArmState::kStopped) {
    state_ = filter_.at_rest() ? ArmState::kHolding : ArmState::kSlowing;
  }
}

void ArmController::Tick(int64_t now_us) noexcept {
  if (safety_.stall_us > 0 && now_us - last_tick_us_ > safety_.stall_us && !filter_.at_rest()) {
    // Nothing was sent meanwhile, so the arm stands where the reference was.
    filter_.Reset(filter_.position());
    Fail(Fault::kOverrun);
  }
  last_tick_us_ = now_us;
  if (!CommandIsValid(now_us)) {
    lifetime_us_ = 0;
    if (Moving()) {
      state_ = ArmState::kSlowing;
      mode_ = ArmMode::kHold;
      stale_ = true;
    }
  }
  if (!link_ok_ && Moving()) state_ = ArmState::kSlowing;
  if (state_ == ArmState::kAligning && Near()) state_ = ArmState::kTracking;
  if (state_ == ArmState::kTracking) {
    filter_.Follow(dq_max_);
  } else if (state_ == ArmState::kAligning) {
    filter_.Follow(dq_max_.cwiseMin(safety_.align_dq));
  } else if (state_ == ArmState::kFault || state_ == ArmState::kStopped) {
    filter_.Halt();
  } else {
    filter_.Brake();
  }
  if (state_ == ArmState::kSlowing && filter_.at_rest()) {
    state_ = ArmState::kHolding;
    held_since_us_ = now_us;
  }
  // The longer one of the two waits decides what it is called.
  if (state_ == ArmState::kHolding) {
    if (!link_ok_ && !unlinked_) {
      unlinked_ = true;
      unlinked_since_us_ = now_us;
    }
    if (stale_ && now_us - held_since_us_ >= kFaultAfterUs) {
      Stop(ArmState::kFault, Fault::kStaleCommand);
    } else if (unlinked_ && now_us - unlinked_since_us_ >= kFaultAfterUs) {
      Stop(ArmState::kFault, Fault::kStaleStatus);
    }
  }
  if (link_ok_) unlinked_ = false;
}

bool ArmController::Busy(int64_t now_us) const noexcept {
  return Moving() || state_ == ArmState::kSlowing || (state_ == ArmState::kHolding && CommandIsValid(now_us));
}

void ArmController::FillStatus(ArmStatus& s) const noexcept {
  s.session = session_;
  s.q_commanded = filter_.position();
  s.gripper_closed = gripper_closed_;
  s.mode = mode_;
  s.state = state_;
  s.fault = fault_;
  s.last_command_seq = last_seq_;
  s.refused = refused_;
}

void ArmController::FillRecord(TickRecord& r) const noexcept {
  r.utime = last_tick_us_;
  r.last_command_seq = last_seq_;
  r.state = static_cast<int8_t>(state_);
  r.fault = static_cast<int8_t>(fault_);
  r.mode = static_cast<int8_t>(mode_);
  r.link_ok = link_ok_;
  r.blocked = filter_.blocked();
  r.halted = filter_.halted();
  r.gripper_closed = gripper_closed_;
  for (int i = 0; i < kNumJoints; ++i) {
    r.q_target[i] = q_target_[i];
    r.q_ref[i] = filter_.position()[i];
    r.dq_ref[i] = filter_.velocity()[i];
    r.ddq_ref[i] = filter_.acceleration()[i];
  }
  r.refused = 0;
  for (const int32_t n : refused_) r.refused += n;
}

}  // namespace intabs
