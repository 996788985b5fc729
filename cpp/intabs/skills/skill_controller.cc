#include "intabs/skills/skill_controller.h"

namespace intabs {

Status SkillController::Tick(const ArmStatus& status, const ObjectPoses& poses, ArmCommand& command) noexcept {
  const bool driver_left = status.state == ArmState::kFault || status.state == ArmState::kStopped ||
                           (status.session != 0 && status.session != session_ &&
                            (status.state == ArmState::kTracking || status.state == ArmState::kAligning));
  if (driver_left) player_.Abort(EndReason::kRefused);
  const int64_t pose_age_us = status.utime - poses.exposure_utime;
  if (pose_age_us > kPosesGoneUs) player_.Abort(EndReason::kStalePoses);

  command = ArmCommand{};
  command.utime = status.utime;
  command.seq = ++seq_;
  command.session = session_;
  command.status_seq = status.seq;
  command.q_target = status.q_commanded;
  Status result = Status::kNotReady;
  if (player_.playing() && (paused_ || pose_age_us > kMaxPoseAgeUs)) {
    // With old poses the plan goes on when there are newer ones; until then nobody moves blindly.
  } else if (player_.playing()) {
    Observation observation;
    observation.q = status.q;
    observation.gripper_closed = status.gripper_closed;
    observation.objects = poses.objects;
    result = player_.Tick(observation, status.q_commanded, command.q_target, gripper_closed_);
    if (result == Status::kOk) command.mode = ArmMode::kServo;
  } else {
    if (player_.status().end_reason == EndReason::kNone) gripper_closed_ = status.gripper_closed;
    if (player_.status().end_reason == EndReason::kFinished) result = Status::kFinished;
  }
  command.gripper_closed = gripper_closed_;
  return result;
}

}  // namespace intabs
