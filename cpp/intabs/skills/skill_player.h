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
#include "intabs/skills/skill_library.h"
#include "intabs/skills/state.h"
#include "intabs/skills/termination.h"

namespace intabs {

inline constexpr float kEffect = 0.05f;        // [m] an object that came so far in the record is demanded to come ...
inline constexpr float kEffectShare = 0.4f;    // ... this share of it
inline constexpr float kDoneShare = 0.75f;     // ... or this much: SkillRecord::done, and of `alone` what is there already
inline constexpr int kMaxRetries = 3;          // in a plan; the first by the same skills
inline constexpr int kMaxSkills = 128;       // in a plan

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
  SkillPlayer(Policy policy, Termination termination, std::shared_ptr<const SkillLibrary> library = nullptr)
      : policy_(std::move(policy)), termination_(std::move(termination)), library_(std::move(library)) {
    if (library_) tried_.resize(library_->chains.size());
  }
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
  const SkillLibrary* library() const noexcept { return library_.get(); }  // null: none

  // Whether what fails may be tried by another demonstration's skills. To try out a demonstration by itself: false.
  void TryOthers(bool on) noexcept { try_others_ = on; }
  // Ablation: pi's output is replaced by zeros.
  void ZeroActions(bool on) noexcept { zero_actions_ = on; }

 private:
  void Begin(int skill, SkillEnd why, const Observation& observation) noexcept;
  void GoOn(SkillEnd why, const Observation& observation) noexcept;
  void Watch(const Observation& observation) noexcept;
  bool Missing(const SkillRecord& record, const Observation& observation) const noexcept;
  int RetryFrom(int skill) const noexcept;
  int ReplaceChain(int skill, const Observation& observation) noexcept;

  Policy policy_;
  Termination termination_;
  std::shared_ptr<const SkillLibrary> library_;
  std::vector<char> tried_;  // chains of the library, in this plan
  bool try_others_ = true;
  std::array<Skill, kMaxSkills> skills_;
  PlayerStatus status_;
  int tick_ = 0;  // in the running skill
  bool at_rest_ = true;   // no target yet
  bool first_ = false;    // the plan has not had a tick
  bool zero_actions_ = false;
  std::array<TrackedObject, kMaxObjects> before_;  // where each object last rested
  std::array<float, kMaxObjects> moved_{};         // as in SkillRecord
  std::array<TrackedObject, kMaxObjects> at_start_;  // as the plan began,
  std::array<float, kMaxObjects> came_{};          // how far each had come from there at most
  JointVector q_target_ = JointVector::Zero();
  bool gripper_closed_ = false;
};

}  // namespace intabs
