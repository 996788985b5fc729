#include "intabs/skills/skill_library.h"

#include <algorithm>
#include <cmath>
#include <fstream>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>
#include <stdexcept>

#include "intabs/core/pose.h"

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

bool Alone(const Chain& chain) {
  const auto there = [](const TrackedObject& object) { return object.id >= 0; };
  return std::count_if(chain.objects.begin(), chain.objects.end(), there) == 1;
}

bool Done(const Skill& skill, const Skill& before) {
  if (!skill.record.alone) return false;
  for (int i = 0; i < kMaxObjects; ++i) {
    if (skill.record.moved[i] > 1.05f * before.record.moved[i] + 0.002f) return false;
  }
  return true;
}

Chain ReadChain(const nlohmann::json& frame, int first, int task) {
  Chain chain;
  chain.first = first;
  chain.task = task;
  const auto q = frame.at("q").get<std::array<double, kNumJoints>>();
  chain.q = Eigen::Map<const JointVector>(q.data());
  for (const auto& [slot, pose] : frame.at("objects").items()) {
    const int i = std::stoi(slot);
    if (i < 0 || i >= kMaxObjects) throw std::invalid_argument("object " + slot + ": there are " + std::to_string(kMaxObjects));
    const auto x = pose.get<std::array<double, 7>>();
    TrackedObject& object = chain.objects[i];
    object.id = i;
    object.valid = true;
    object.X_WO.p << x[0], x[1], x[2];
    object.X_WO.q = Eigen::Quaterniond(x[3], x[4], x[5], x[6]).normalized();
    if (!object.X_WO.IsFinite()) throw std::invalid_argument("a pose is not finite");
  }
  return chain;
}

}  // namespace

SkillLibrary SkillLibrary::Load(const std::string& dir) {
  const std::string path = dir + "/skills.json";
  std::ifstream file(path);
  if (!file) throw std::runtime_error(path + ": cannot be read; export the weights again");
  SkillLibrary library;
  try {
    const nlohmann::json all = nlohmann::json::parse(file);
    std::map<std::string, int> tasks;
    std::map<std::pair<std::string, std::string>, int> chains;
    for (const nlohmann::json& j : all.at("skills")) {
      Skill skill = ReadSkill(j);
      const auto task = j.at("task").get<std::string>();
      const auto [at, is_new] = chains.try_emplace({task, j.at("source").get<std::string>()}, library.chains.size());
      if (is_new) {
        const int number = tasks.try_emplace(task, tasks.size()).first->second;
        library.chains.push_back(ReadChain(j.at("frames").at(0), static_cast<int>(library.skills.size()), number));
      }
      skill.chain = at->second;
      skill.record.alone = Alone(library.chains.back());
      if (!is_new) skill.record.done = Done(skill, library.skills.back());
      if (at->second + 1 != static_cast<int>(library.chains.size())) throw std::invalid_argument("its demonstration is in two pieces");
      ++library.chains.back().count;
      library.skills.push_back(skill);
    }
    for (const nlohmann::json& j : all.at("practice")) {
      const auto at = chains.find({j.at("task").get<std::string>(), j.at("source").get<std::string>()});
      if (at != chains.end()) library.chains[at->second].rate = j.at("success").get<float>() / j.at("trials").get<float>();
    }
  } catch (const std::exception& e) {  // nlohmann's messages may hold several lines of what it read
    std::string what = e.what();
    what = what.substr(0, what.find('\n'));
    throw std::runtime_error(path + ": skill " + std::to_string(library.skills.size()) + ": " + what);
  }
  return library;
}

int SkillLibrary::Nearest(int chain, const Observation& now, const std::vector<char>& out) const noexcept {
  const int task = chains[chain].task;
  float best = 0;
  for (const Chain& c : chains) {
    if (c.task == task) best = std::max(best, c.rate);
  }
  int nearest = -1;
  double least = std::numeric_limits<double>::infinity();
  for (size_t i = 0; i < chains.size(); ++i) {
    const Chain& c = chains[i];
    if (c.task != task || out[i] || c.rate < best - kAsGood) continue;
    double apart = kTurnLength * (c.q - now.q).cwiseAbs().maxCoeff();
    for (int k = 0; k < kMaxObjects; ++k) {
      const TrackedObject &was = c.objects[k], &is = now.objects[k];
      if (was.id < 0 || is.id < 0 || !is.valid) continue;
      apart += (was.X_WO.p - is.X_WO.p).norm() + kTurnLength * AngleBetween(was.X_WO.q, is.X_WO.q);
    }
    if (apart < least) {
      least = apart;
      nearest = static_cast<int>(i);
    }
  }
  return nearest;
}

}  // namespace intabs
