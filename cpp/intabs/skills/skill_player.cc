#include "intabs/skills/skill_player.h"

#include <algorithm>
#include <functional>
#include <limits>

#include "intabs/core/pose.h"

namespace intabs {

namespace {

float Apart(const Pose& a, const Pose& b) {
  return static_cast<float>((b.p - a.p).norm() + kTurnLength * AngleBetween(a.q, b.q));
}

// Nothing was moving or held as it began.
bool Free(const SkillRecord& record) {
  return !record.closed && std::all_of(record.rested.begin(), record.rested.end(), std::identity{});
}

}  // namespace

SkillPlayer SkillPlayer::Load(const std::string& dir, const ArmModel& arm, const NetworkOptions& options) {
  const WeightsFile weights = WeightsFile::Load(dir);
  return {Policy::FromWeights(weights, arm, options), Termination(weights, options),
          std::make_shared<const SkillLibrary>(SkillLibrary::Load(dir))};
}

Status SkillPlayer::Start(int64_t plan_id, std::span<const Skill> skills) noexcept {
  if (skills.empty() || skills.size() > kMaxSkills) return Status::kOutOfRange;
  for (const Skill& s : skills) {
    if (s.min_ticks < 1 || s.max_ticks < s.min_ticks || s.max_ticks > kMaxSkillTicks || !s.z.allFinite()) return Status::kOutOfRange;
  }
  at_rest_ = !playing() || (first_ && at_rest_);  // a plan that had no tick yet left no target
  std::copy(skills.begin(), skills.end(), skills_.begin());
  status_ = PlayerStatus{};
  status_.plan_id = plan_id;
  status_.n_skills = static_cast<int>(skills.size());
  status_.end_reason = EndReason::kRunning;
  std::fill(tried_.begin(), tried_.end(), 0);
  first_ = true;
  return Status::kOk;
}

void SkillPlayer::Abort(EndReason why) noexcept {
  if (playing()) status_.end_reason = why;
}

// pi and eta are trained on skills that start from a zero state.
void SkillPlayer::Begin(int skill, SkillEnd why, const Observation& observation) noexcept {
  status_.skill_index = skill;
  status_.skill_end = why;
  status_.progress = 0;
  tick_ = 0;
  policy_.Reset();
  termination_.Reset();
  for (int i = 0; i < kMaxObjects; ++i) {
    if (!skills_[skill].record.rested[i]) continue;
    before_[i] = observation.objects[i];
    moved_[i] = 0;
  }
}

// What is not seen is not judged.
void SkillPlayer::Watch(const Observation& observation) noexcept {
  for (int i = 0; i < kMaxObjects; ++i) {
    const TrackedObject& is = observation.objects[i];
    if (!is.valid) continue;
    if (before_[i].id >= 0 && before_[i].valid) moved_[i] = std::max(moved_[i], Apart(before_[i].X_WO, is.X_WO));
    if (at_start_[i].id >= 0 && at_start_[i].valid) came_[i] = std::max(came_[i], Apart(at_start_[i].X_WO, is.X_WO));
  }
}

// Whether an object did not move as recorded.
bool SkillPlayer::Missing(const SkillRecord& record, const Observation& observation) const noexcept {
  for (int i = 0; i < kMaxObjects; ++i) {
    if (record.moved[i] <= kEffect || before_[i].id < 0 || !before_[i].valid || !observation.objects[i].valid) continue;
    const float nearly_all = kDoneShare * record.moved[i];
    // What is there already counts: a lid that came up only as it was tried again is not to be opened twice.
    if (record.alone && came_[i] >= nearly_all) continue;
    if (moved_[i] < (record.done ? nearly_all : kEffectShare * record.moved[i])) return true;
  }
  return false;
}

// The first of the skills that led up to the object's motion, before it was grasped: pi has learned to begin that one from
// anywhere, those closer to the grasp only from beside the demonstration.
int SkillPlayer::RetryFrom(int skill) const noexcept {
  while (skill > 0 && !Free(skills_[skill].record)) --skill;
  while (skill > 0 && Free(skills_[skill - 1].record)) --skill;
  return skill;
}

// Puts the skills of another demonstration of the task in the place of this skill's, if the plan holds all of those. Returns
// the first of them, or -1.
int SkillPlayer::ReplaceChain(int skill, const Observation& observation) noexcept {
  const int chain = skills_[skill].chain;
  if (!try_others_ || !library_ || chain < 0) return -1;
  const int n = status_.n_skills;
  int begin = skill, end = skill + 1;
  while (begin > 0 && skills_[begin - 1].chain == chain) --begin;
  while (end < n && skills_[end].chain == chain) ++end;
  if (end - begin != library_->chains[chain].count) return -1;
  tried_[chain] = 1;
  const int other = library_->Nearest(chain, observation, tried_);
  if (other < 0) return -1;
  const Chain& with = library_->chains[other];
  const int longer = with.count - (end - begin);
  if (n + longer > kMaxSkills) return -1;
  if (longer > 0) {
    std::move_backward(skills_.begin() + end, skills_.begin() + n, skills_.begin() + n + longer);
  } else {
    std::move(skills_.begin() + end, skills_.begin() + n, skills_.begin() + end + longer);
  }
  std::copy_n(library_->skills.begin() + with.first, with.count, skills_.begin() + begin);
  status_.n_skills = n + longer;
  return begin;
}

// The running skill is over.
void SkillPlayer::GoOn(SkillEnd why, const Observation& observation) noexcept {
  if (Missing(skills_[status_.skill_index].record, observation)) {
    if (status_.retries == kMaxRetries) {
      status_.end_reason = EndReason::kNoEffect;
      return;
    }
    // What failed twice is likely to fail again: then as another demonstration did it.
    const int other = status_.retries++ ? ReplaceChain(status_.skill_index, observation) : -1;
    Begin(other < 0 ? RetryFrom(status_.skill_index) : other, SkillEnd::kNoEffect, observation);
  } else if (status_.skill_index + 1 == status_.n_skills) {
    status_.end_reason = EndReason::kFinished;
    status_.skill_end = why;
  } else {
    Begin(status_.skill_index + 1, why, observation);
  }
}

Status SkillPlayer::Tick(const Observation& observation, const JointVector& q_commanded, JointVector& q_target,
                         bool& gripper_closed) noexcept {
  if (status_.end_reason == EndReason::kFinished) return Status::kFinished;
  if (!playing()) return Status::kNotReady;
  const auto fail = [this](Status status) {
    Abort(EndReason::kBadInput);
    return status;
  };
  StateVector s;
  if (const Status status = policy_.codec().Sense(observation, s); status != Status::kOk) return fail(status);
  if (first_) {
    if (at_rest_) {
      q_target_ = q_commanded;
      gripper_closed_ = observation.gripper_closed;
    }
    first_ = false;
    before_ = at_start_ = observation.objects;  // also for a plan that begins amid a motion
    moved_.fill(0);
    came_.fill(0);
    Begin(0, SkillEnd::kNone, observation);
  }
  Watch(observation);
  if (tick_ > 0) {
    const Skill& skill = skills_[status_.skill_index];
    if (const Status status = termination_.Step(s, skill.z, tick_); status != Status::kOk) return fail(status);
    if (tick_ >= skill.max_ticks) {
      GoOn(SkillEnd::kLongest, observation);
    } else if (tick_ >= skill.min_ticks && termination_.over()) {
      GoOn(SkillEnd::kTerminated, observation);
    }
  }
  if (status_.end_reason == EndReason::kFinished) return Status::kFinished;
  if (!playing()) return Status::kNotReady;
  const Skill& skill = skills_[status_.skill_index];
  if (tick_ == 0) {
    if (const Status status = termination_.Step(s, skill.z, 0); status != Status::kOk) return fail(status);
  }
  Action action;
  if (const Status status = policy_.Step(observation, s, skill.z, SkillPhase(skill, tick_), action); status != Status::kOk) {
    return fail(status);
  }
  if (!zero_actions_) {
    // Saturated: a target beyond a joint's limit is refused by the driver, and the whole arm would come to a stop.
    const ArmModel& arm = policy_.codec().arm();
    q_target_ = (q_target_ + action.dq_step).cwiseMax(arm.q_min()).cwiseMin(arm.q_max());
    gripper_closed_ = action.gripper_closed;
  }
  q_target = q_target_;
  gripper_closed = gripper_closed_;
  ++tick_;
  status_.b = termination_.b();
  status_.progress = static_cast<float>(tick_) / static_cast<float>(skill.max_ticks);
  return Status::kOk;
}

}  // namespace intabs
