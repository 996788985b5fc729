#include "intabs/skills/policy.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <stdexcept>

namespace intabs {
namespace {

template <typename Vector>
Vector ReadVector(const Manifest& manifest, const std::string& dir, const std::string& path) {
  const std::vector<double> numbers = manifest.Numbers(path);
  Vector v;
  if (static_cast<int>(numbers.size()) != v.size()) {
    throw std::runtime_error(dir + "/manifest.json: " + path + " has " + std::to_string(numbers.size()) +
                             " numbers, this program needs " + std::to_string(v.size()));
  }
  for (int i = 0; i < v.size(); ++i) v[i] = static_cast<float>(numbers[i]);
  if (!v.allFinite()) throw std::runtime_error(dir + "/manifest.json: " + path + " holds a number too large for float");
  return v;
}

void Demand(bool ok, const std::string& dir, const std::string& what) {
  if (!ok) throw std::runtime_error(dir + "/manifest.json: " + what);
}

}  // namespace

Policy Policy::Load(const std::string& dir, const ArmModel& arm, const NetworkOptions& options) {
  return FromWeights(WeightsFile::Load(dir), arm, options);
}

Policy Policy::FromWeights(const WeightsFile& weights, const ArmModel& arm, const NetworkOptions& options) {
  const std::string& dir = weights.label();
  const Manifest& manifest = weights.manifest();
  const std::string layout = manifest.Text("/state_layout");
  Demand(layout == kStateLayout, dir, "state layout \"" + layout + "\", this program knows \"" + kStateLayout + "\"");
  const int64_t period = manifest.Integer("/policy_period_us");
  Demand(period == kPolicyPeriodUs, dir,
         "policy period " + std::to_string(period) + " us, this program runs at " + std::to_string(kPolicyPeriodUs));
  Policy policy(arm, Network(weights, "pi", options));
  const NetworkSpec& spec = manifest.network("pi");
  policy.with_phase_ = spec.input == kPolicyInputDim;
  Demand(policy.with_phase_ || spec.input == kStateDim + kLatentDim, dir,
         "pi takes " + std::to_string(spec.input) + " inputs, the state layout, z and the phase give " +
             std::to_string(kPolicyInputDim));
  policy.agent_head_ = policy.pi_.HeadIndex("agent");
  policy.environment_head_ = policy.pi_.HeadIndex("environment");
  Demand(policy.pi_.head_size(policy.agent_head_) == kAgentActionDim &&
             policy.pi_.head_size(policy.environment_head_) == kEnvironmentActionDim,
         dir, "pi's heads must be agent (7) and environment (24)");
  policy.normalizer_.mean = ReadVector<StateVector>(manifest, dir, "/normalizer/state_mean");
  const StateVector scale = ReadVector<StateVector>(manifest, dir, "/normalizer/state_scale");
  Demand((scale.array() > 0).all(), dir, "/normalizer/state_scale must be positive");
  policy.normalizer_.inverse_scale = scale.cwiseInverse();
  Demand((policy.normalizer_.inverse_scale.array() > 0).all() && policy.normalizer_.inverse_scale.allFinite(), dir,
         "/normalizer/state_scale holds a number that is too large or too small");
  policy.normalizer_.limit = static_cast<float>(manifest.Number("/normalizer/limit"));
  Demand(policy.normalizer_.limit > 0, dir, "/normalizer/limit must be positive");
  policy.agent_scale_ =
      ReadVector<Eigen::Matrix<float, kAgentActionDim, 1>>(manifest, dir, "/normalizer/agent_action_scale");
  policy.environment_scale_ =
      ReadVector<Eigen::Matrix<float, kEnvironmentActionDim, 1>>(manifest, dir, "/normalizer/environment_action_scale");
  Demand((policy.agent_scale_.array() > 0).all() && (policy.environment_scale_.array() > 0).all(), dir,
         "/normalizer/agent_action_scale and environment_action_scale must be positive");
  // A step of a radian a tick is ten times what the arm can do: such weights are broken.
  Demand((policy.agent_scale_.head<kNumJoints>().array() < 1).all(), dir,
         "/normalizer/agent_action_scale holds a joint step of 1 rad a tick or more");
  return policy;
}

Status Policy::Step(const Observation& observation, const LatentVector& z, float phase, Action& action) noexcept {
  StateVector s;
  if (const Status status = AssembleState(arm_, observation, s); status != Status::kOk) return status;
  normalizer_.Apply(s);
  input_.head<kStateDim>() = s;
  if (with_phase_) {
    input_.segment<kLatentDim>(kStateDim + kPhaseBasis) = z;
    for (int k = 0; k < kPhaseBasis; ++k) {
      const float b = std::max(0.f, 1.f - std::abs(phase * (kPhaseBasis - 1) - static_cast<float>(k)));
      input_[kStateDim + k] = b;
      input_.segment<kLatentDim>(kStateDim + kPhaseBasis + kLatentDim * (1 + k)) = b * z;
    }
  } else {
    input_.segment<kLatentDim>(kStateDim) = z;
  }
  const auto before = std::chrono::steady_clock::now();
  if (const Status status = pi_.Step(input_.data()); status != Status::kOk) return status;
  infer_us_ = std::chrono::duration<float, std::micro>(std::chrono::steady_clock::now() - before).count();
  const auto agent = pi_.Head(agent_head_);
  const auto environment = pi_.Head(environment_head_);
  for (int i = 0; i < kNumJoints; ++i) action.dq_step[i] = agent[i] * agent_scale_[i];
  action.gripper_closed = agent[kNumJoints] > 0.f;
  for (int i = 0; i < kEnvironmentActionDim; ++i) action.object_motion[i] = environment[i] * environment_scale_[i];
  return action.dq_step.allFinite() && action.object_motion.allFinite() ? Status::kOk : Status::kInvalidInput;
}

}  // namespace intabs
