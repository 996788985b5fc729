#include "intabs/skills/policy.h"

#include <algorithm>
#include <catch2/catch.hpp>
#include <cmath>

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
    for (int i = 0; i < kNumJoints; ++i) CHECK(action.dq_step[i] == Approx(.01 * agent[i]).margin(1e-9));
    CHECK(action.gripper_closed == (agent[kNumJoints] > 0.f));
  }
}

}  // namespace
}  // namespace intabs
