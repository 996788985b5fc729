// Plays a plan of skills: state assembly, pi, joint targets. Between pi's output and the command stand only
// denormalisation and integration.
#pragma once

#include <array>
#include <memory>
#include <span>
#include <string>

#include "intabs/core/status.h"
#include "intabs/core/types.h"
#include "intabs/skills/policy.h"
#include "intabs/skills/state.h"

namespace intabs {

struct Skill {
  LatentVector z = LatentVector::Zero();
  int32_t min_ticks = 1;  // of the policy
  int32_t max_ticks = 1;
};

inline constexpr int kMaxSkills = 128;       // in a plan
inline constexpr int kMaxSkillTicks = 15000;  // 10 minutes

// Why the player is not playing. The numbers travel in SKILL_STATUS.
enum class EndReason : int8_t {
  kNone = 0,      // nothing played yet
  kRunning = 1,
  kFinished = 2,  // every skill was played
  kAborted = 3,
  kStalePoses = 4,   // no object poses for too long: perception is gone
  kBadInput = 5,     // a reading or pi's output was not finite
  kRefused = 6,      // the driver left tracking: fault, ESTOP, or another session
};

struct PlayerStatus {
  int64_t plan_id = 0;
  int skill_index = 0;
  int n_skills = 0;
  float progress = 0;  // of the running skill, 0 .. 1
  EndReason end_reason = EndReason::kNone;
};

class SkillPlayer {
 public:
  explicit SkillPlayer(Policy policy) : policy_(std::move(policy)) {}

  // Replaces the plan; integration starts at the next Tick from `q_commanded` given there. Real-time safe.
  // kOutOfRange if the plan is empty, longer than kMaxSkills, or a skill's duration is not 1 <= min <= max <= kMaxSkillTicks.
  Status Start(int64_t plan_id, std::span<const Skill> skills) noexcept;

  // One policy tick: the next joint target [rad] and gripper bit. Real-time safe.
  // q_commanded: where the command filter stands, used at the first tick of a plan only.
  // kNotReady without a plan, kFinished after its last tick, kInvalidInput (playing ends) on a reading that is not finite.
  Status Tick(const Observation& observation, const JointVector& q_commanded, JointVector& q_target,
              bool& gripper_closed) noexcept;

  void Abort(EndReason why) noexcept;
  bool playing() const noexcept { return status_.end_reason == EndReason::kRunning; }
  const PlayerStatus& status() const noexcept { return status_; }
  const Policy& policy() const noexcept { return policy_; }

  // Ablation: pi's output is replaced by zeros.
  void ZeroActions(bool on) noexcept { zero_actions_ = on; }

 private:
  Policy policy_;
  std::array<Skill, kMaxSkills> skills_;
  PlayerStatus status_;
  int tick_ = 0;  // in the running skill
  bool first_ = false;
  bool zero_actions_ = false;
  JointVector q_target_ = JointVector::Zero();
  bool gripper_closed_ = false;
};

}  // namespace intabs
