#include "intabs/skills/policy.h"

#include <algorithm>
#include <catch2/catch.hpp>
#include <cmath>
#include <utility>

#include "intabs/core/pose.h"
#include "policy_weights.h"

namespace intabs {
namespace {

// [s, b, z, z b_0, ..., z b_4], written out as in python/intabs/model/networks.py.
Eigen::VectorXf Input(const StateVector& s, const LatentVector& z, float phase) {
  Eigen::VectorXf basis(kPhaseBasis);
  const float at[kPhaseBasis] = {0.f, .25f, .5f, .75f, 1.f};
  for (int k = 0; k < kPhaseBasis; ++k) basis[k] = std::max(0.f, 1.f - 4.f * std::abs(phase - at[k]));
  Eigen::VectorXf x(kPolicyInputDim);
  x << s, basis, z, z * basis[0], z * basis[1], z * basis[2], z * basis[3], z * basis[4];
  return x;
}

TEST_CASE("The policy sees state, skill and phase as in training") {
  const WeightsFile weights = RandomPolicyWeights();
  const ArmModel arm = ArmModel::Lite6();
  Policy policy = Policy::FromWeights(weights, arm);
  Network pi(weights, "pi");
  Observation observation;
  observation.q << .1, .2, 1.1, 0., .9, .3;
  observation.objects[0].id = 1;
  observation.objects[0].valid = true;
  observation.objects[0].X_WO.p << .25, .05, .03;
  LatentVector z;
  for (int i = 0; i < kLatentDim; ++i) z[i] = .1f * static_cast<float>(i) - .7f;
  StateVector s;
  REQUIRE(AssembleState(arm, observation, s) == Status::kOk);
  Normalizer normalizer;
  normalizer.mean.setConstant(.1f);
  normalizer.inverse_scale.setConstant(2.f);
  normalizer.Apply(s);
  for (const float phase : {0.f, .1f, .25f, .6f, 1.f}) {
    Action action;
    REQUIRE(policy.Step(observation, s, z, phase, action) == Status::kOk);
    const Eigen::VectorXf x = Input(s, z, phase);
    REQUIRE(pi.Step(x.data()) == Status::kOk);
    const auto agent = pi.Head(pi.HeadIndex("agent"));
    const auto twist = pi.Head(pi.HeadIndex("twist"));
    const auto response = pi.Head(pi.HeadIndex("response"));
    JointVector step, moved;  // what the twists add
    for (int i = 0; i < kNumJoints; ++i) {
      step[i] = action.dq_step[i] - .01 * agent[i];
      moved[i] = action.response[i] - .01 * 8 * std::tanh(response[i] / 8);
    }
    CHECK((step - moved).norm() > 1e-4);
    for (const auto& [dq, at] : {std::pair{step, 0}, std::pair{moved, kTwistDim}}) {
      const Pose motion = arm.Tip(observation.q).Inverse() * arm.Tip(observation.q + dq);
      const Eigen::Vector3d w = LogSO3(motion.q);
      for (int i = 0; i < 3; ++i) {
        // Damped, and a twist is no finite motion: 10 %, and a fifth of a millimetre or of a hundredth of a radian.
        CHECK(motion.p[i] == Approx(.005 * 8 * std::tanh(twist[at + i] / 8)).epsilon(.1).margin(2e-4));
        CHECK(w[i] == Approx(.005 * 8 * std::tanh(twist[at + 3 + i] / 8)).epsilon(.1).margin(2e-3));
      }
    }
    CHECK(action.gripper_closed == (agent[kNumJoints] > 0.f));
  }
}

}  // namespace
}  // namespace intabs
