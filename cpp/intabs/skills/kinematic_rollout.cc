#include "intabs/skills/kinematic_rollout.h"

#include <algorithm>

namespace intabs {

KinematicRollout::KinematicRollout(const WeightsFile& weights, const ArmModel& arm, int n, const NetworkOptions& options)
    : batch_(Network(weights, "pi", options), n),
      codec_(weights, arm, batch_.network()),
      input_(static_cast<size_t>(n) * kPolicyInputDim, 0.f),
      zero_(static_cast<size_t>(batch_.network().state_size()), 0.f) {}

Status KinematicRollout::Begin(const Observation& start, std::span<const std::vector<Skill>> plans) {
  if (plans.empty() || plans.size() > static_cast<size_t>(size())) return Status::kOutOfRange;
  ticks_ = 0;
  for (const std::vector<Skill>& plan : plans) {
    if (plan.empty()) return Status::kOutOfRange;
    int n = 0;
    for (const Skill& s : plan) n += ExpectedTicks(s);
    ticks_ = std::max(ticks_, n);
  }
  states_.assign(plans.size(), start);
  places_.assign(plans.size(), Place{});
  batch_.Reset();
  return Status::kOk;
}

Status KinematicRollout::Tick(std::span<const std::vector<Skill>> plans) {
  for (size_t i = 0; i < plans.size(); ++i) {
    Place& at = places_[i];
    if (at.skill == plans[i].size()) continue;
    const Skill& skill = plans[i][at.skill];
    if (at.tick == 0) batch_.RestoreState(static_cast<int>(i), zero_.data());
    StateVector s;
    if (const Status status = codec_.Sense(states_[i], s); status != Status::kOk) return status;
    codec_.Encode(s, skill.z, SkillPhase(skill, at.tick), &input_[i * kPolicyInputDim]);
  }
  if (const Status status = batch_.Step(input_.data()); status != Status::kOk) return status;
  const auto agent = batch_.Head(codec_.agent_head), environment = batch_.Head(codec_.environment_head);
  const auto response = batch_.Head(codec_.response_head), carried = batch_.Head(codec_.carried_head);
  for (size_t i = 0; i < plans.size(); ++i) {
    Place& at = places_[i];
    if (at.skill == plans[i].size()) continue;
    const auto row = static_cast<Eigen::Index>(i);
    Action action;
    const PolicyCodec::Heads heads{agent.row(row).data(), environment.row(row).data(), response.row(row).data(),
                                   carried.row(row).data()};
    if (const Status status = codec_.Decode(states_[i], heads, action); status != Status::kOk) return status;
    codec_.Advance(action, states_[i]);
    if (++at.tick == ExpectedTicks(plans[i][at.skill])) at = {at.skill + 1, 0};
  }
  return Status::kOk;
}

}  // namespace intabs
