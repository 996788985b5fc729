#include "intabs/skills/termination.h"

#include <cmath>
#include <stdexcept>

namespace intabs {

Termination::Termination(const WeightsFile& weights, const NetworkOptions& options) : eta_(weights, "eta", options) {
  if (eta_.input_size() != kTerminationInputDim || !eta_.HasHead("b") || eta_.head_size(eta_.HeadIndex("b")) != 1) {
    throw std::runtime_error(weights.label() + "/manifest.json: eta must take " + std::to_string(kTerminationInputDim) +
                             " inputs and have a head \"b\" of one value; export the weights again");
  }
  b_head_ = eta_.HeadIndex("b");
}

void Termination::Reset() noexcept {
  eta_.Reset();
  b_ = 0;
  lasting_ = 1;
}

Status Termination::Step(const StateVector& s, const LatentVector& z, int age) noexcept {
  input_ << s, z, static_cast<float>(age) / kAgeUnit;
  if (const Status status = eta_.Step(input_.data()); status != Status::kOk) return status;
  const float logit = eta_.Head(b_head_)[0];
  if (!std::isfinite(logit)) return Status::kInvalidInput;
  b_ = age > 0 ? 1.f / (1.f + std::exp(-logit)) : 0.f;
  lasting_ *= 1.f - b_;
  return Status::kOk;
}

}  // namespace intabs
