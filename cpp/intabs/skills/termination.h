// When a skill is over: the high-level policy eta(b | s, z, age) of one weights folder.
#pragma once

#include "intabs/core/status.h"
#include "intabs/nn/network.h"
#include "intabs/skills/state.h"

namespace intabs {

inline constexpr float kAgeUnit = 20.f;  // ticks
inline constexpr int kTerminationInputDim = kStateDim + kLatentDim + 1;  // [s, z, age / kAgeUnit]

// eta gives at each tick the probability b that the skill ends there if it has not yet. The skill is over at the median of
// the times so described: when the product of all 1 - b has fallen below a half.
class Termination {
 public:
  // Throws std::runtime_error with one line if the weights have no eta or another one.
  explicit Termination(const WeightsFile& weights, const NetworkOptions& options = {});

  // A skill begins. Real-time safe.
  void Reset() noexcept;
  // One tick of the running skill, from its first on, in which it cannot end; s: normalised features. Real-time safe.
  Status Step(const StateVector& s, const LatentVector& z, int age) noexcept;
  float b() const noexcept { return b_; }
  bool over() const noexcept { return lasting_ < 0.5f; }

 private:
  Network eta_;
  int b_head_ = 0;
  float b_ = 0, lasting_ = 1;
  Eigen::Matrix<float, kTerminationInputDim, 1> input_;
};

}  // namespace intabs
