#include "mirror.h"

namespace intabs {

void Mirror::OnMaster(const ArmStatus& master, int64_t now_us) {
  master_ = master;
  master_heard_us_ = now_us;
}

void Mirror::OnPuppet(const ArmStatus& puppet, int64_t now_us) {
  if (puppet.source != source_) {  // another plant or driver
    source_ = puppet.source;
    last_ = ArmCommand{};
    together_ = false;
  }
  if (lockstep_) {
    if (puppet.utime % kPolicyPeriodUs != 0) return;
    if (answered_ > 0 && puppet.seq == last_.status_seq) {
      again_ = true;
      return;
    }
    if (waiting_ && waiting_->seq == puppet.seq) return;  // sent again while we wait for the master
  }
  waiting_ = puppet;
  waiting_since_us_ = now_us;
}

bool Mirror::Answer(int64_t now_us, ArmCommand& command) {
  if (again_) {
    again_ = false;
    command = last_;
    return true;
  }
  if (!waiting_ || !master_) return false;
  const bool spoke = lockstep_ ? master_->seq == waiting_->seq : now_us - master_heard_us_ <= kSilentUs;
  if (!spoke && lockstep_ && now_us - waiting_since_us_ <= kSilentLockstepUs) return false;
  silent_ = !spoke;

  command = ArmCommand{};
  command.utime = waiting_->utime;
  command.seq = ++seq_;
  command.session = session_;
  command.status_seq = waiting_->seq;
  if (silent_) {
    together_ = false;
    ++held_;
    command.mode = ArmMode::kHold;
    command.q_target = waiting_->q_commanded;
    command.gripper_closed = waiting_->gripper_closed;
  } else {
    command.mode = ArmMode::kServo;
    // A master at its stop may read a little beyond it; the puppet would refuse that.
    command.q_target = master_->q.cwiseMax(model_.q_min()).cwiseMin(model_.q_max());
    command.gripper_closed = master_->gripper_closed;
    together_ = together_ || (command.q_target - waiting_->q_commanded).cwiseAbs().maxCoeff() < kTogether;
    if (!together_) command.dq_max.setConstant(kApproachSpeed);
  }
  ++answered_;
  last_ = command;
  waiting_.reset();
  return true;
}

}  // namespace intabs
