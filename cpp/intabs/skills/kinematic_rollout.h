// Plans played in the head: pi closed on its own predictions, without arm or simulator. Many at once, for planning.
#pragma once

#include <span>
#include <vector>

#include "intabs/skills/skill_player.h"

namespace intabs {

class KinematicRollout {
 public:
  // At most n plans at a time. Throws std::runtime_error if the weights do not fit.
  KinematicRollout(const WeightsFile& weights, const ArmModel& arm, int n, const NetworkOptions& options = {});

  int size() const { return batch_.size(); }
  // Plays each plan from `start` to its end, every skill as long as it is expected to last; a plan that is over keeps its
  // last state. visit(t): after each tick t = 0, 1, ...; states() are then those after it. kInvalidInput: `start` or an
  // output is not finite; kOutOfRange: no plans, more than size(), or an empty one.
  template <class Visit>
  Status Run(const Observation& start, std::span<const std::vector<Skill>> plans, Visit visit) {
    if (const Status status = Begin(start, plans); status != Status::kOk) return status;
    for (int t = 0; t < ticks_; ++t) {
      if (const Status status = Tick(plans); status != Status::kOk) return status;
      visit(t);
    }
    return Status::kOk;
  }
  std::span<const Observation> states() const { return states_; }

 private:
  struct Place {
    size_t skill = 0;
    int tick = 0;
  };
  Status Begin(const Observation& start, std::span<const std::vector<Skill>> plans);
  Status Tick(std::span<const std::vector<Skill>> plans);

  NetworkBatch batch_;
  PolicyCodec codec_;
  std::vector<float> input_, zero_;
  std::vector<Observation> states_;
  std::vector<Place> places_;
  int ticks_ = 0;
};

}  // namespace intabs
