#include "intabs/skills/policy.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <stdexcept>

#include "intabs/core/pose.h"

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

constexpr float kSquash = 8.f;  // predicted changes saturate at so many of their training deviations

float Squash(float x) { return kSquash * std::tanh(x / kSquash); }

}  // namespace

PolicyCodec::PolicyCodec(const WeightsFile& weights, const ArmModel& arm, const Network& pi) : arm_(arm) {
  const std::string& dir = weights.label();
  const Manifest& manifest = weights.manifest();
  const std::string layout = manifest.Text("/state_layout");
  Demand(layout == kStateLayout, dir, "state layout \"" + layout + "\", this program knows \"" + kStateLayout + "\"");
  const int64_t period = manifest.Integer("/policy_period_us");
  Demand(period == kPolicyPeriodUs, dir,
         "policy period " + std::to_string(period) + " us, this program runs at " + std::to_string(kPolicyPeriodUs));
  Demand(pi.input_size() == kPolicyInputDim, dir,
         "pi takes " + std::to_string(pi.input_size()) + " inputs, the state layout, z and the phase give " +
             std::to_string(kPolicyInputDim));
  const auto head = [&](const char* name, int size) {
    Demand(pi.HasHead(name) && pi.head_size(pi.HeadIndex(name)) == size, dir,
           std::string("pi needs a head \"") + name + "\" of " + std::to_string(size) + " values; export the weights again");
    return pi.HeadIndex(name);
  };
  agent_head = head("agent", kAgentActionDim);
  environment_head = head("environment", kEnvironmentActionDim);
  response_head = head("response", kNumJoints);
  carried_head = head("carried", kMaxObjects);
  normalizer_.mean = ReadVector<StateVector>(manifest, dir, "/normalizer/state_mean");
  const StateVector scale = ReadVector<StateVector>(manifest, dir, "/normalizer/state_scale");
  Demand((scale.array() > 0).all(), dir, "/normalizer/state_scale must be positive");
  normalizer_.inverse_scale = scale.cwiseInverse();
  Demand((normalizer_.inverse_scale.array() > 0).all() && normalizer_.inverse_scale.allFinite(), dir,
         "/normalizer/state_scale holds a number that is too large or too small");
  normalizer_.limit = static_cast<float>(manifest.Number("/normalizer/limit"));
  Demand(normalizer_.limit > 0, dir, "/normalizer/limit must be positive");
  agent_scale_ = ReadVector<decltype(agent_scale_)>(manifest, dir, "/normalizer/agent_action_scale");
  response_scale_ = ReadVector<decltype(response_scale_)>(manifest, dir, "/normalizer/response_scale");
  environment_scale_ = ReadVector<decltype(environment_scale_)>(manifest, dir, "/normalizer/environment_action_scale");
  Demand((agent_scale_.array() > 0).all() && (environment_scale_.array() > 0).all() && (response_scale_.array() > 0).all(),
         dir, "/normalizer/agent_action_scale, environment_action_scale and response_scale must be positive");
  // A step of a radian a tick is ten times what the arm can do: such weights are broken.
  Demand((agent_scale_.head<kNumJoints>().array() < 1).all(), dir,
         "/normalizer/agent_action_scale holds a joint step of 1 rad a tick or more");
}

Status PolicyCodec::Sense(const Observation& observation, StateVector& s) const noexcept {
  if (const Status status = AssembleState(arm_, observation, s); status != Status::kOk) return status;
  normalizer_.Apply(s);
  return Status::kOk;
}

void PolicyCodec::Encode(const StateVector& s, const LatentVector& z, float phase, float* x) const noexcept {
  Eigen::Map<Eigen::Matrix<float, kPolicyInputDim, 1>> input(x);
  input.head<kStateDim>() = s;
  input.segment<kLatentDim>(kStateDim + kPhaseBasis) = z;
  for (int k = 0; k < kPhaseBasis; ++k) {
    const float b = std::max(0.f, 1.f - std::abs(phase * (kPhaseBasis - 1) - static_cast<float>(k)));
    input[kStateDim + k] = b;
    input.segment<kLatentDim>(kStateDim + kPhaseBasis + kLatentDim * (1 + k)) = b * z;
  }
}

Status PolicyCodec::Decode(const Observation& observation, const Heads& heads, Action& action) const noexcept {
  for (int i = 0; i < kNumJoints; ++i) {
    action.dq_step[i] = heads.agent[i] * agent_scale_[i];
    action.response[i] = Squash(heads.response[i]) * response_scale_[i];
  }
  action.gripper_closed = heads.agent[kNumJoints] > 0.f;
  const Pose X_WG = arm_.Tip(observation.q);
  const Pose X_WG_next = arm_.Tip(observation.q + action.response);
  for (int i = 0; i < kMaxObjects; ++i) {
    auto motion = action.object_motion.segment<kObjectMotionDim>(kObjectMotionDim * i);
    for (int k = 0; k < kObjectMotionDim; ++k) {
      const int at = kObjectMotionDim * i + k;
      motion[k] = Squash(heads.environment[at]) * environment_scale_[at];
    }
    // Truly 0 or 1 where pi is sure: a far object must not stir.
    action.held[i] = std::clamp(1.2f / (1.f + std::exp(-heads.carried[i])) - 0.1f, 0.f, 1.f);
    const TrackedObject& o = observation.objects[i];
    if (o.id < 0) {
      motion.setZero();
    } else {
      motion += action.held[i] * ObjectMotion(X_WG, o.X_WO, X_WG_next * X_WG.Inverse() * o.X_WO);
    }
  }
  return action.dq_step.allFinite() && action.response.allFinite() && action.object_motion.allFinite() ? Status::kOk
                                                                                                       : Status::kInvalidInput;
}

void PolicyCodec::Advance(const Action& action, Observation& observation) const noexcept {
  const Pose X_WG = arm_.Tip(observation.q);
  for (int i = 0; i < kMaxObjects; ++i) {
    TrackedObject& o = observation.objects[i];
    if (o.id < 0) continue;
    const auto motion = action.object_motion.segment<kObjectMotionDim>(kObjectMotionDim * i).cast<double>();
    o.X_WO.p += X_WG.q * motion.head<3>();
    o.X_WO.q = (ExpSO3(X_WG.q * motion.tail<3>()) * o.X_WO.q).normalized();
  }
  observation.q += action.response;
  observation.gripper_closed = action.gripper_closed;
}

Policy Policy::Load(const std::string& dir, const ArmModel& arm, const NetworkOptions& options) {
  return FromWeights(WeightsFile::Load(dir), arm, options);
}

Policy Policy::FromWeights(const WeightsFile& weights, const ArmModel& arm, const NetworkOptions& options) {
  return Policy(weights, arm, Network(weights, "pi", options));
}

Status Policy::Step(const Observation& observation, const StateVector& s, const LatentVector& z, float phase,
                    Action& action) noexcept {
  codec_.Encode(s, z, phase, input_.data());
  const auto before = std::chrono::steady_clock::now();
  if (const Status status = pi_.Step(input_.data()); status != Status::kOk) return status;
  infer_us_ = std::chrono::duration<float, std::micro>(std::chrono::steady_clock::now() - before).count();
  return codec_.Decode(observation,
                       {pi_.Head(codec_.agent_head).data(), pi_.Head(codec_.environment_head).data(),
                        pi_.Head(codec_.response_head).data(), pi_.Head(codec_.carried_head).data()},
                       action);
}

}  // namespace intabs
