// The skills of the demonstrations, encoded: skills.json beside the weights, as the exporter writes it.
#pragma once

#include <string>
#include <vector>

#include "intabs/skills/skill_player.h"

namespace intabs {

// Throws std::runtime_error with one line that names the file and what is wrong with it.
std::vector<Skill> LoadSkillLibrary(const std::string& weights_dir);

}  // namespace intabs
