// The low-level policy pi(a_t | s_1:t, z): network, state features and normaliser of one weights folder.
#pragma once

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
// What pi takes: [s, b(phase), z, z b_0(phase), ..., z b_4(phase)], b of a skill's phase in [0, 1]; older weights [s, z].
inline constexpr int kPolicyInputDim = kStateDim + kPhaseBasis + kLatentDim * (1 + kPhaseBasis);

struct Action {
  JointVector dq_step = JointVector::Zero();  // step of the joint target [rad a tick]
  bool gripper_closed = false;
  // Predicted motion of each slot's object in this tick, see ObjectMotion: a prediction, never a measurement. Beside what
  // the tip carries along, which pi says in a head of its own (python/intabs/model/networks.py).
  Eigen::Matrix<float, kEnvironmentActionDim, 1> object_motion = Eigen::Matrix<float, kEnvironmentActionDim, 1>::Zero();
};

class Policy {
 public:
  // Loads `pi` from a weights folder (weights.safetensors + manifest.json). Throws std::runtime_error with one line that
  // names what does not fit.
  static Policy Load(const std::string& weights_dir, const ArmModel& arm, const NetworkOptions& options = {});
  static Policy FromWeights(const WeightsFile& weights, const ArmModel& arm, const NetworkOptions& options = {});

  void Reset() noexcept { pi_.Reset(); }
  // Real-time safe. kInvalidInput if a reading or the output is not finite.
  // phase: 0 at the skill's first tick, 1 at its last and after.
  Status Step(const Observation& observation, const LatentVector& z, float phase, Action& action) noexcept;
  float infer_us() const noexcept { return infer_us_; }  // of the last Step, the network alone

 private:
  Policy(const ArmModel& arm, Network pi) : arm_(arm), pi_(std::move(pi)) {}

  ArmModel arm_;
  Network pi_;
  Normalizer normalizer_;
  Eigen::Matrix<float, kAgentActionDim, 1> agent_scale_;
  Eigen::Matrix<float, kEnvironmentActionDim, 1> environment_scale_;
  Eigen::Matrix<float, kPolicyInputDim, 1> input_;
  int agent_head_ = 0, environment_head_ = 0;
  bool with_phase_ = true;
  float infer_us_ = 0;
};

}  // namespace intabs
