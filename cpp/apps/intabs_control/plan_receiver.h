// Skill plans come in parts, each one message, in any order.
#pragma once

#include <optional>
#include <vector>

#include "intabs/bus/messages.h"
#include "intabs/skills/skill_player.h"

namespace intabs {

// Puts them together. A part of another plan begins anew.
class PlanReceiver {
 public:
  // True when `plan` has become complete.
  bool Add(const SkillPlan& m) {
    constexpr int kMaxParts = (kMaxSkills + kMaxSkillsPerPart - 1) / kMaxSkillsPerPart;
    if (m.plan_id <= 0 || m.parts < 1 || m.parts > kMaxParts || m.part < 0 || m.part >= m.parts) return false;
    if (m.plan_id != id_ || static_cast<int>(parts_.size()) != m.parts) {
      id_ = m.plan_id;
      parts_.assign(m.parts, std::nullopt);
    }
    parts_[m.part] = m;
    skills_.clear();
    for (const auto& part : parts_) {
      if (!part) return false;
      for (int i = 0; i < part->n; ++i) {
        skills_.push_back({part->skills[i].z, part->skills[i].min_ticks, part->skills[i].max_ticks});
      }
    }
    return true;
  }
  int64_t id() const { return id_; }
  const std::vector<Skill>& skills() const { return skills_; }

 private:
  int64_t id_ = 0;
  std::vector<std::optional<SkillPlan>> parts_;
  std::vector<Skill> skills_;
};

}  // namespace intabs
