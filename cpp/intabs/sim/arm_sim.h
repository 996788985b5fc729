// The arm in the plant: command filter and MuJoCo world, ticked together. The same object is inside
// intabs_plant and in in-process rollouts, so both give the same trajectory for the same commands.
#pragma once

#include <cstdint>
#include <string>

#include "intabs/control/arm_controller.h"
#include "intabs/core/types.h"
#include "intabs/plant/world.h"

namespace intabs {

// What a world knows now. seq and frame_seq are the caller's.
void FillTruth(const World& world, PlantTruth& truth);

// Deterministic: a reset and the commands with the ticks they come at decide everything. One thread. Time is
// simulation time from 0; where a wall clock rules, pass its time as `now_us` instead, always or never
// between two resets.
class ArmSim {
 public:
  // Throws on an unknown task or a broken model.
  ArmSim(const std::string& models_dir, const std::string& task);

  // Starts over: the task's objects displaced by `seed` and `spread_cm`, the arm idle in its home pose, time
  // 0.
  void Reset(int64_t seed, double spread_cm) { Reset(seed, spread_cm, 0); }
  void Reset(int64_t seed, double spread_cm, int64_t now_us);

  Refusal Accept(const ArmCommand& command) noexcept { return Accept(command, world_.time_us()); }
  Refusal Accept(const ArmCommand& command, int64_t now_us) noexcept {
    return controller_.Accept(command, now_us);
  }

  void Nudge(int slot, const Eigen::Vector3d& dp_W) { world_.Nudge(slot, dp_W); }

  // One driver tick of 4 ms: the filter's step, then the world's. Watchdogs see the time at its end.
  void Tick() { Tick(world_.time_us() + kDriverPeriodUs); }
  void Tick(int64_t now_us);

  // What the driver says now. seq counts the ticks from 1; in between two resets it names the time.
  // source, last_frame_seq, overruns and tick_us are the caller's.
  void Status(ArmStatus& status) const;

  // What the plant knows now. seq and frame_seq are the caller's.
  void Truth(PlantTruth& truth) const;

  ArmController& controller() noexcept { return controller_; }
  const ArmController& controller() const noexcept { return controller_; }
  const World& world() const noexcept { return world_; }

 private:
  World world_;
  ArmController controller_;
  int64_t ticks_ = 0;
};

}  // namespace intabs
