// The causal variant of FilterHand: one hand, frames as they come.
#pragma once

#include <array>
#include <vector>

#include "intabs/perception/hand.h"

namespace intabs {

struct HandEstimate {
  HandPoints hand_W;
  std::array<double, kHandPoints> sigma{};  // of a coordinate [m]; 0 where nothing is known
};

// The filters of FilterHand look at the frames of the last second; the newest one is what is told. A first
// wrong detection is taken, for there is nothing to tell it by. A point that is not seen or thrown out is
// foretold (kFilled) by a GapTracker for options.gaps.max_gap after it was measured last.
class HandTracker {
 public:
  static constexpr double kWindow = 1.0;  // [s]

  explicit HandTracker(const HandFilterOptions& options = {});

  // A frame whose time is not after the last one's starts a new sequence. Allocates.
  HandEstimate Update(const HandFrame& frame);
  void Reset();

 private:
  HandFilterOptions options_;
  GapTrackerOptions gap_options_;
  std::vector<HandFrame> frames_;
  std::array<GapTracker, kHandPoints> gaps_;
};

}  // namespace intabs
