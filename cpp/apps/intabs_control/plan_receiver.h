// Skill plans come in parts, each one message, in any order.
#pragma once

#include <optional>
#include <span>
#include <vector>

#include "intabs/bus/messages.h"
#include "intabs/skills/skill_player.h"

namespace intabs {

// Puts them together. A part of another plan begins anew.
class PlanReceiver {
 public:
  // True when `plan` has become complete.
  // A skill with an index is that of `library`, an index out of range leaves it one that no player takes; with bounds of its own
  // (above 0) it keeps them.
  bool Add(const SkillPlan& m, std::span<const Skill> library = {}) {
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
        const SkillPlan::Skill& sent = part->skills[i];
        Skill skill{sent.z, sent.min_ticks, sent.max_ticks, {}};
        if (sent.library_index >= 0) {
          const auto at = static_cast<size_t>(sent.library_index);
          skill = at < library.size() ? library[at] : Skill{LatentVector::Zero(), 0, 0, {}};
          if (at < library.size() && sent.max_ticks > 0) {
            skill.min_ticks = sent.min_ticks;
            skill.max_ticks = sent.max_ticks;
          }
        }
        skills_.push_back(skill);
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
