// The low-level policy pi(a_t | s_1:t, z): network, state features and normaliser of one weights folder.
#pragma once

#include <array>
#include <memory>
#include <string>

#include "intabs/core/status.h"
#include "intabs/nn/network.h"
#include "intabs/skills/state.h"

namespace intabs {

// y = (x - mean) / scale, clamped to +-limit.
struct Normalizer {
  StateVector mean = StateVector::Zero();
  StateVector inverse_scale = StateVector::Ones();
  float limit = 5.f;
  void Apply(StateVector& s) const noexcept {
    s = ((s - mean).array() * inverse_scale.array()).cwiseMax(-limit).cwiseMin(limit);
  }
};

// Hat functions at kPhaseBasis places of a skill's phase: what lets pi's linear path say a course in time.
inline constexpr int kPhaseBasis = 5;
// What pi takes: [s, b(phase), z, z b_0(phase), ..., z b_4(phase)], b of a skill's phase in [0, 1].
inline constexpr int kPolicyInputDim = kStateDim + kPhaseBasis + kLatentDim * (1 + kPhaseBasis);

struct Action {
  JointVector dq_step = JointVector::Zero();  // step of the joint target [rad a tick]
  bool gripper_closed = false;
  // Predictions for this tick, never measurements:
  JointVector response = JointVector::Zero();  // how far the joints will have moved [rad]: a servo lags behind its target
  std::array<float, kMaxObjects> held{};       // 0 .. 1, how far the tip carries each object
  // Motion of each slot's object, see ObjectMotion: what the tip carries along, and what moves beside that.
  Eigen::Matrix<float, kEnvironmentActionDim, 1> object_motion = Eigen::Matrix<float, kEnvironmentActionDim, 1>::Zero();
};

// What stands before and behind the network pi: features and scales. Real-time safe but for the constructor.
class PolicyCodec {
 public:
  // Throws std::runtime_error with one line that names what in the manifest does not fit.
  PolicyCodec(const WeightsFile& weights, const ArmModel& arm, const Network& pi);

  // Normalised features. kInvalidInput if a reading is not finite.
  Status Sense(const Observation& observation, StateVector& s) const noexcept;
  // x: kPolicyInputDim values. phase: 0 at the skill's first tick, 1 at its last and after.
  void Encode(const StateVector& s, const LatentVector& z, float phase, float* x) const noexcept;
  // From pi's heads, each at its first value. kInvalidInput if one is not finite.
  struct Heads {
    const float *agent, *environment, *response, *carried;
  };
  Status Decode(const Observation& observation, const Heads& heads, Action& action) const noexcept;
  // The observation a tick later if it goes as `action` foretells.
  void Advance(const Action& action, Observation& observation) const noexcept;

  const ArmModel& arm() const { return arm_; }
  int agent_head, environment_head, response_head, carried_head;

 private:
  ArmModel arm_;
  Normalizer normalizer_;
  Eigen::Matrix<float, kAgentActionDim, 1> agent_scale_;
  Eigen::Matrix<float, kNumJoints, 1> response_scale_;
  Eigen::Matrix<float, kEnvironmentActionDim, 1> environment_scale_;
};

class Policy {
 public:
  // Loads `pi` from a weights folder (weights.safetensors + manifest.json). Throws std::runtime_error with one line that
  // names what does not fit.
  static Policy Load(const std::string& weights_dir, const ArmModel& arm, const NetworkOptions& options = {});
  static Policy FromWeights(const WeightsFile& weights, const ArmModel& arm, const NetworkOptions& options = {});

  void Reset() noexcept { pi_.Reset(); }
  // Real-time safe. kInvalidInput if a reading or the output is not finite.
  // s: of codec().Sense(observation). phase: 0 at the skill's first tick, 1 at its last and after.
  Status Step(const Observation& observation, const StateVector& s, const LatentVector& z, float phase, Action& action) noexcept;
  float infer_us() const noexcept { return infer_us_; }  // of the last Step, the network alone
  const PolicyCodec& codec() const noexcept { return codec_; }

 private:
  Policy(const WeightsFile& weights, const ArmModel& arm, Network pi)
      : codec_(weights, arm, pi), pi_(std::move(pi)) {}

  PolicyCodec codec_;
  Network pi_;
  Eigen::Matrix<float, kPolicyInputDim, 1> input_;
  float infer_us_ = 0;
};

}  // namespace intabs
