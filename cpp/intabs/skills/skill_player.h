// Plays a plan of skills: state assembly, pi, joint targets. Between pi's output and the command stand only
// denormalisation and integration, which stops at the joints' limits. A skill ends when eta says so, within its bounds; one
// whose effect on the objects did not happen is tried again.
#pragma once

#include <array>
#include <memory>
#include <span>
#include <string>

#include "intabs/core/status.h"
#include "intabs/core/types.h"
#include "intabs/skills/policy.h"
#include "intabs/skills/state.h"
#include "intabs/skills/termination.h"

namespace intabs {

// What the demonstration did in a skill, to notice when it does not happen and to know where to try again from.
struct SkillRecord {
  // How far each object had come at most by its end, |dp| + kTurnLength * angle [m], from where it last rested as a skill
  // began; whether it did so as this one began.
  std::array<float, kMaxObjects> moved{};
  std::array<bool, kMaxObjects> rested{};
  bool closed = false;  // the gripper was, as this one began
  SkillRecord() { rested.fill(true); }
};

struct Skill {
  LatentVector z = LatentVector::Zero();
  int32_t min_ticks = 1;  // of the policy; it is expected to last the mean of the two
  int32_t max_ticks = 1;
  SkillRecord record;  // nothing moved: nothing is demanded
};

// How long it is expected to last [ticks], and at which phase of it a tick is: 0 the first, 1 the last and after.
inline int ExpectedTicks(const Skill& s) { return (s.min_ticks + s.max_ticks) / 2; }
inline float SkillPhase(const Skill& s, int tick) {
  const int last = ExpectedTicks(s) - 1;
  return last < 1 || tick >= last ? (tick > 0 ? 1.f : 0.f) : static_cast<float>(tick) / static_cast<float>(last);
}

inline constexpr float kTurnLength = 0.1f;     // [m/rad]
inline constexpr float kEffect = 0.05f;        // [m] an object that came so far in the record is demanded to come ...
inline constexpr float kEffectShare = 0.4f;    // ... this share of it
inline constexpr int kMaxRetries = 3;          // in a plan
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
  kNoEffect = 7,     // an object did not move as in the demonstration, kMaxRetries times
};

// How the skill before the running one ended. The numbers travel in SKILL_STATUS.
enum class SkillEnd : int8_t {
  kNone = 0,      // the plan's first skill runs
  kTerminated = 1,  // eta said so
  kLongest = 2,     // max_ticks
  kNoEffect = 3,    // an object did not move as recorded: the running skill is a retry
};

struct PlayerStatus {
  int64_t plan_id = 0;
  int skill_index = 0;
  int n_skills = 0;
  float progress = 0;  // of the running skill, 0 .. 1
  float b = 0;         // eta's probability that it ends now
  int retries = 0;
  SkillEnd skill_end = SkillEnd::kNone;
  EndReason end_reason = EndReason::kNone;
};

class SkillPlayer {
 public:
  SkillPlayer(Policy policy, Termination termination)
      : policy_(std::move(policy)), termination_(std::move(termination)) {}
  // Throws std::runtime_error with one line that names what in the folder does not fit.
  static SkillPlayer Load(const std::string& weights_dir, const ArmModel& arm, const NetworkOptions& options = {});

  // Replaces the plan, also while one is played: the target moves on from where it stands. Real-time safe.
  // kOutOfRange if the plan is empty, longer than kMaxSkills, or a skill's duration is not 1 <= min <= max <= kMaxSkillTicks.
  Status Start(int64_t plan_id, std::span<const Skill> skills) noexcept;

  // One policy tick: the next joint target [rad] and gripper bit. Real-time safe.
  // q_commanded: where the command filter stands; the target moves on from there when a plan begins at rest.
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
  void Begin(int skill, SkillEnd why, const Observation& observation) noexcept;
  void GoOn(SkillEnd why, const Observation& observation) noexcept;
  void Watch(const Observation& observation) noexcept;
  bool Missing(const SkillRecord& record, const Observation& observation) const noexcept;
  int RetryFrom(int skill) const noexcept;

  Policy policy_;
  Termination termination_;
  std::array<Skill, kMaxSkills> skills_;
  PlayerStatus status_;
  int tick_ = 0;  // in the running skill
  bool at_rest_ = true;   // no target yet
  bool first_ = false;    // the plan has not had a tick
  bool zero_actions_ = false;
  std::array<TrackedObject, kMaxObjects> before_;  // where each object last rested
  std::array<float, kMaxObjects> moved_{};         // as in SkillRecord
  JointVector q_target_ = JointVector::Zero();
  bool gripper_closed_ = false;
};

}  // namespace intabs
