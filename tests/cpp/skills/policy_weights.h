// Random weights of a policy, as the exporter writes them.
#pragma once

#include <string>
#include <vector>

#include "intabs/skills/policy.h"
#include "nn/random_weights.h"

namespace intabs {

inline std::string Numbers(int n, double value) {
  std::string s = "[";
  for (int i = 0; i < n; ++i) s += (i ? "," : "") + std::to_string(value);
  return s + "]";
}

inline WeightsFile RandomPolicyWeights(int inputs = kPolicyInputDim, const std::string& layout = kStateLayout,
                                       int64_t period = kPolicyPeriodUs) {
  NetworkSpec spec;
  spec.input = inputs;
  spec.input_linear = 128;
  spec.layers = 8;
  spec.hidden = 128;
  spec.residual = true;
  spec.heads = {{"agent", kAgentActionDim}, {"environment", kEnvironmentActionDim}};
  std::vector<uint8_t> image = SafeTensorsImage(RandomNetwork("pi", spec, 3));
  const std::string extra = "\"state_layout\":\"" + layout + "\",\"policy_period_us\":" + std::to_string(period) +
                            ",\"normalizer\":{\"state_mean\":" + Numbers(kStateDim, 0.1) +
                            ",\"state_scale\":" + Numbers(kStateDim, 0.5) +
                            ",\"agent_action_scale\":" + Numbers(kAgentActionDim, 0.01) +
                            ",\"environment_action_scale\":" + Numbers(kEnvironmentActionDim, 0.01) + ",\"limit\":5},";
  const std::string sha = Sha256Hex(image.data(), image.size());
  return WeightsFile::Parse(std::move(image),
                            Manifest::Parse(ManifestText({{"pi", spec}}, sha, extra), "weights/t/manifest.json"),
                            "weights/t");
}

}  // namespace intabs
