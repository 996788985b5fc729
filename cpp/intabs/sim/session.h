// In-process twin of intabs_plant + intabs_perception in lockstep: the same World, command filter, perception and order
// of events, without LCM. Rollouts and the demonstrator's tests run here; a test holds both ways against each other.
#pragma once

#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "intabs/perception/pipeline.h"
#include "intabs/plant/renderer.h"
#include "intabs/sim/arm_sim.h"

namespace intabs {

class Session {
 public:
  // perception: poses come from rendered tags; absent: from the plant's truth. Throws on an unknown task.
  Session(const std::string& models_dir, const std::string& task, std::optional<PerceptionConfig> perception);

  // Starts over; status() and poses() are those of the first policy tick.
  void Reset(int64_t seed, double spread_cm);

  // Answers the current policy tick and goes on to the next one, 40 ms later.
  Refusal Advance(const ArmCommand& command);

  // See World::Nudge.
  void Nudge(int slot, const Eigen::Vector3d& dp_W) { sim_.Nudge(slot, dp_W); }

  const ArmStatus& status() const { return status_; }
  const ObjectPoses& poses() const { return poses_; }
  const World& world() const { return sim_.world(); }

 private:
  void Look();

  ArmSim sim_;
  std::optional<PerceptionConfig> config_;
  std::unique_ptr<Renderer> renderer_;
  std::unique_ptr<Pipeline> pipeline_;
  Snapshot snapshot_;
  ArmStatus status_;
  ObjectPoses poses_;
  int64_t frame_seq_ = 0;
};

}  // namespace intabs
