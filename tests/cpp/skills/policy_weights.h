// Random weights of a policy, as the exporter writes them.
#pragma once

#include <string>
#include <cstring>
#include <vector>

#include "intabs/skills/policy.h"
#include "intabs/skills/termination.h"
#include "nn/random_weights.h"

namespace intabs {

inline std::string Numbers(int n, double value) {
  std::string s = "[";
  for (int i = 0; i < n; ++i) s += (i ? "," : "") + std::to_string(value);
  return s + "]";
}

// eta_logit: added to eta's logit that a skill is over.
inline WeightsFile RandomPolicyWeights(int inputs = kPolicyInputDim, const std::string& layout = kStateLayout,
                                       int64_t period = kPolicyPeriodUs, float eta_logit = 0) {
  NetworkSpec pi;
  pi.input = inputs;
  pi.input_linear = 128;
  pi.layers = 8;
  pi.hidden = 128;
  pi.residual = true;
  pi.heads = {
      {"agent", kAgentActionDim}, {"environment", kEnvironmentActionDim}, {"response", kNumJoints}, {"carried", kMaxObjects}};
  NetworkSpec eta;
  eta.input = kTerminationInputDim;
  eta.layers = 1;
  eta.hidden = 16;
  eta.heads = {{"b", 1}};
  RawTensors tensors = RandomNetwork("pi", pi, 3);
  tensors.merge(RandomNetwork("eta", eta, 4));
  std::vector<uint8_t>& bias = tensors.at("eta.heads.b.bias").bytes;
  float b = 0;
  std::memcpy(&b, bias.data(), sizeof b);
  b += eta_logit;
  std::memcpy(bias.data(), &b, sizeof b);
  std::vector<uint8_t> image = SafeTensorsImage(tensors);
  const std::string extra = "\"state_layout\":\"" + layout + "\",\"policy_period_us\":" + std::to_string(period) +
                            ",\"normalizer\":{\"state_mean\":" + Numbers(kStateDim, 0.1) +
                            ",\"state_scale\":" + Numbers(kStateDim, 0.5) +
                            ",\"agent_action_scale\":" + Numbers(kAgentActionDim, 0.01) +
                            ",\"response_scale\":" + Numbers(kNumJoints, 0.01) +
                            ",\"environment_action_scale\":" + Numbers(kEnvironmentActionDim, 0.01) + ",\"limit\":5},";
  const std::string sha = Sha256Hex(image.data(), image.size());
  return WeightsFile::Parse(std::move(image),
                            Manifest::Parse(ManifestText({{"pi", pi}, {"eta", eta}}, sha, extra), "weights/t/manifest.json"),
                            "weights/t");
}

}  // namespace intabs
