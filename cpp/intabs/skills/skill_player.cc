#include "intabs/skills/skill_player.h"

namespace intabs {

namespace {

// The skill is expected to last the mean of its bounds.
float Phase(const Skill& skill, int tick) {
  const int last = (skill.min_ticks + skill.max_ticks) / 2 - 1;
  return last < 1 || tick >= last ? (tick > 0 ? 1.f : 0.f) : static_cast<float>(tick) / static_cast<float>(last);
}

}  // namespace

Status SkillPlayer::Start(int64_t plan_id, std::span<const Skill> skills) noexcept {
  if (skills.empty() || skills.size() > kMaxSkills) return Status::kOutOfRange;
  for (const Skill& s : skills) {
    if (s.min_ticks < 1 || s.max_ticks < s.min_ticks || s.max_ticks > kMaxSkillTicks || !s.z.allFinite()) return Status::kOutOfRange;
  }
  std::copy(skills.begin(), skills.end(), skills_.begin());
  status_ = {plan_id, 0, static_cast<int>(skills.size()), 0.f, EndReason::kRunning};
  tick_ = 0;
  first_ = true;
  return Status::kOk;
}

void SkillPlayer::Abort(EndReason why) noexcept {
  if (playing()) status_.end_reason = why;
}

Status SkillPlayer::Tick(const Observation& observation, const JointVector& q_commanded, JointVector& q_target,
                         bool& gripper_closed) noexcept {
  if (status_.end_reason == EndReason::kFinished) return Status::kFinished;
  if (!playing()) return Status::kNotReady;
  if (first_) {
    q_target_ = q_commanded;
    gripper_closed_ = observation.gripper_closed;
    first_ = false;
  }
  if (tick_ == 0) policy_.Reset();  // trained on segments that start from a zero state
  Action action;
  const Skill& skill = skills_[status_.skill_index];
  const Status status = policy_.Step(observation, skill.z, Phase(skill, tick_), action);
  if (status != Status::kOk) {
    Abort(EndReason::kBadInput);
    return status;
  }
  if (!zero_actions_) {
    q_target_ += action.dq_step;
    gripper_closed_ = action.gripper_closed;
  }
  q_target = q_target_;
  gripper_closed = gripper_closed_;

  ++tick_;
  status_.progress = static_cast<float>(tick_) / static_cast<float>(skills_[status_.skill_index].max_ticks);
  if (tick_ >= skills_[status_.skill_index].max_ticks) {
    if (status_.skill_index + 1 == status_.n_skills) {
      status_.end_reason = EndReason::kFinished;
    } else {
      ++status_.skill_index;
      tick_ = 0;
      status_.progress = 0;
    }
  }
  return Status::kOk;
}

}  // namespace intabs
