#include "intabs/perception/hand_tracker.h"

#include <algorithm>

namespace intabs {

HandTracker::HandTracker(const HandFilterOptions& options) : options_(options) {
  gap_options_.max_gap = options.gaps.max_gap;
  gap_options_.sigma = options.gaps.sigma;
  options_.goes_on = true;
  options_.gaps.max_gap = 0;  // nothing comes after the newest frame to fill towards
  Reset();
}

void HandTracker::Reset() {
  frames_.clear();
  gaps_.fill(GapTracker(gap_options_));
}

HandEstimate HandTracker::Update(const HandFrame& frame) {
  if (!frames_.empty() && !(frame.time > frames_.back().time)) Reset();
  std::erase_if(frames_, [&](const HandFrame& f) { return frame.time - f.time > kWindow; });
  frames_.push_back(frame);
  HandEstimate out{FilterHand(frames_, options_).back(), {}};
  for (int i = 0; i < kHandPoints; ++i) {
    if (out.hand_W.state[i] == PointState::kMeasured) {
      (void)gaps_[i].Update(frame.time, {out.hand_W.p[i], Eigen::Quaterniond::Identity()});
      out.sigma[i] = gap_options_.sigma;
    } else if (const GapEstimate there = gaps_[i].Predict(frame.time); there.valid) {
      out.hand_W.p[i] = there.pose.p;
      out.hand_W.state[i] = PointState::kFilled;
      out.sigma[i] = there.sigma;
    }
  }
  return out;
}

}  // namespace intabs
