#include "intabs/skills/skill_library.h"

#include <cmath>
#include <fstream>
#include <nlohmann/json.hpp>
#include <stdexcept>

namespace intabs {
namespace {

void Read(const nlohmann::json& array, float* out, size_t n) {
  if (array.size() != n) throw std::invalid_argument("an array of " + std::to_string(n) + " numbers has " + std::to_string(array.size()));
  for (size_t i = 0; i < n; ++i) {
    out[i] = array.at(i).get<float>();
    if (!std::isfinite(out[i])) throw std::invalid_argument("a number is not finite");
  }
}

Skill ReadSkill(const nlohmann::json& j) {
  Skill skill;
  Read(j.at("z"), skill.z.data(), kLatentDim);
  skill.min_ticks = j.at("min_ticks").get<int32_t>();
  skill.max_ticks = j.at("max_ticks").get<int32_t>();
  if (skill.min_ticks < 1 || skill.max_ticks < skill.min_ticks || skill.max_ticks > kMaxSkillTicks) {
    throw std::invalid_argument("needs 1 <= min_ticks <= max_ticks <= " + std::to_string(kMaxSkillTicks));
  }
  Read(j.at("moved"), skill.record.moved.data(), kMaxObjects);
  const nlohmann::json& rested = j.at("rested");
  for (int i = 0; i < kMaxObjects; ++i) skill.record.rested[i] = rested.at(i).get<bool>();
  skill.record.closed = j.at("frames").at(0).at("gripper_closed").get<bool>();
  return skill;
}

}  // namespace

std::vector<Skill> LoadSkillLibrary(const std::string& dir) {
  const std::string path = dir + "/skills.json";
  std::ifstream file(path);
  if (!file) throw std::runtime_error(path + ": cannot be read; export the weights again");
  std::vector<Skill> skills;
  try {
    const nlohmann::json all = nlohmann::json::parse(file);
    for (const nlohmann::json& j : all.at("skills")) skills.push_back(ReadSkill(j));
  } catch (const std::exception& e) {  // nlohmann's messages may hold several lines of what it read
    std::string what = e.what();
    what = what.substr(0, what.find('\n'));
    throw std::runtime_error(path + ": skill " + std::to_string(skills.size()) + ": " + what);
  }
  return skills;
}

}  // namespace intabs
