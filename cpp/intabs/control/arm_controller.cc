#include "intabs/control/arm_controller.h"

namespace intabs {

ArmController::ArmController(const ArmLimits& limits, const ArmModel& model) noexcept
    : filter_(limits, model) {}

void ArmController::Reset(const JointVector& q_measured, int64_t now_us) noexcept {
  *this = ArmController(filter_.limits(), filter_.model());
  filter_.Reset(q_measured);
}

Refusal ArmController::Check(const ArmCommand& c, int64_t now_us) const noexcept {
  const bool same_session = c.session == session_ && session_ != 0;
  bool may_command = false;
  switch (state_) {
    case ArmState::kIdle:
      may_command = true;
      break;
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
  session_ = c.session;
  reserved_ = 0;
  last_seq_ = c.seq;
  has_seq_ = true;
  received_us_ = now_us;
  lifetime_us_ = c.lifetime_us;
  stale_ = false;
  mode_ = c.mode;
  if (c.mode == ArmMode::kServo) {
    state_ = ArmState::kTracking;
    q_target_ = c.q_target;
    dq_max_ = c.dq_max.cwiseMin(filter_.limits().dq_max);
    gripper_closed_ = c.gripper_closed;
  } else if (state_ != ArmState::kHolding) {
    state_ = ArmState::kSlowing;
  }
  return Refusal::kAccepted;
}

void ArmController::Estop() noexcept {
  state_ = ArmState::kStopped;
  fault_ = Fault::kEstop;
  mode_ = ArmMode::kHold;
  lifetime_us_ = 0;
  stale_ = false;
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
  if (!CommandIsValid(now_us)) {
    lifetime_us_ = 0;
    if (state_ == ArmState::kTracking) {
      state_ = ArmState::kSlowing;
      mode_ = ArmMode::kHold;
      stale_ = true;
    }
  }
  if (state_ == ArmState::kTracking) {
    filter_.Follow(q_target_, dq_max_);
  } else {
    filter_.Brake();
  }
  if (state_ == ArmState::kSlowing && filter_.at_rest()) {
    state_ = ArmState::kHolding;
    held_since_us_ = now_us;
  }
  if (state_ == ArmState::kHolding && stale_ && now_us - held_since_us_ >= kFaultAfterUs) {
    state_ = ArmState::kFault;
    fault_ = Fault::kStaleCommand;
  }
}

bool ArmController::Busy(int64_t now_us) const noexcept {
  return state_ == ArmState::kTracking || state_ == ArmState::kSlowing ||
         (state_ == ArmState::kHolding && CommandIsValid(now_us));
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

}  // namespace intabs
