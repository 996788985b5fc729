// The skills of the demonstrations, encoded: skills.json beside the weights, as the exporter writes it.
#pragma once

#include <array>
#include <string>
#include <vector>

#include "intabs/skills/policy.h"
#include "intabs/skills/state.h"

namespace intabs {

inline constexpr float kTurnLength = 0.1f;    // [m/rad]
inline constexpr int kMaxSkillTicks = 15000;  // 10 minutes

// What the demonstration did in a skill, to notice when it does not happen and to know where to try again from.
struct SkillRecord {
  // How far each object had come at most by its end, |dp| + kTurnLength * angle [m], from where it last rested as a skill
  // began; whether it did so as this one began.
  std::array<float, kMaxObjects> moved{};
  std::array<bool, kMaxObjects> rested{};
  bool closed = false;  // the gripper was, as this one began
  bool alone = false;   // nothing else was there on which it could depend how far an object came: a drawer, a lid
  bool done = false;    // likewise, and all of `moved` was done before this one began
  SkillRecord() { rested.fill(true); }
};

struct Skill {
  LatentVector z = LatentVector::Zero();
  int32_t min_ticks = 1;  // of the policy; it is expected to last the mean of the two
  int32_t max_ticks = 1;
  SkillRecord record;  // nothing moved: nothing is demanded
  int chain = -1;      // SkillLibrary::chains that it belongs to; -1: none
};

// How long it is expected to last [ticks], and at which phase of it a tick is: 0 the first, 1 the last and after.
inline int ExpectedTicks(const Skill& s) { return (s.min_ticks + s.max_ticks) / 2; }
inline float SkillPhase(const Skill& s, int tick) {
  const int last = ExpectedTicks(s) - 1;
  return last < 1 || tick >= last ? (tick > 0 ? 1.f : 0.f) : static_cast<float>(tick) / static_cast<float>(last);
}

// The skills of one demonstration, in time.
struct Chain {
  int first = 0, count = 0;  // of SkillLibrary::skills
  int task = 0;              // the same number: the same task
  float rate = 1;            // how often they did it in practice, 0 .. 1
  JointVector q = JointVector::Zero();                // as it began
  std::array<TrackedObject, kMaxObjects> objects;  // likewise; id -1: not there
};

struct SkillLibrary {
  std::vector<Skill> skills;
  std::vector<Chain> chains;

  // Throws std::runtime_error with one line that names the file and what is wrong with it.
  static SkillLibrary Load(const std::string& weights_dir);

  // Of the demonstrations that do this chain's task in practice about as well as the best one (kAsGood), the one that began
  // most like now, but for those that are `out` (a flag a chain); -1: none is left. Real-time safe.
  int Nearest(int chain, const Observation& now, const std::vector<char>& out) const noexcept;
};

inline constexpr float kAsGood = 0.15f;

}  // namespace intabs
