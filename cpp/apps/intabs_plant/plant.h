// One simulated arm on the bus: its loops and what it listens to.
#pragma once

#include <cstdint>
#include <memory>
#include <string>

#include "intabs/bus/lcm_bus.h"
#include "intabs/rt/tick_stats.h"
#include "intabs/sim/arm_sim.h"
#include "options.h"
#include "view.h"

namespace intabs {

class Plant {
 public:
  // Throws on what cannot work; listens a moment for another one on the same channels.
  explicit Plant(const PlantOptions& options);

  // Until a stop signal. Throws after 10 s without an answer in lockstep, or when another plant turns up.
  void Run();

 private:
  // A policy tick's answer, in the order of their weight.
  enum class Answer { kNone, kStranger, kGiven };

  void RunLockstep();
  void RunWall();
  // False: stopped, or started over.
  bool WaitForAnswer();

  void OnCommand(const ArmCommand& command);
  void OnStatus(const ArmStatus& status);
  void OnControl(const PlantControl& control);
  void Handle(int timeout_ms);

  bool Moves() const;
  bool Lockstep() const { return options_.clock == "lockstep"; }
  int64_t NowUs() const;
  void StartOver(int64_t seed, double spread_cm);
  // One driver tick.
  void Tick();
  // Hands the world to the cameras; counts frames.
  void Look();
  void PublishTruth();
  void PublishStatus();
  void PublishLoopStatusNowAndThen();
  void WriteJson() const;

  const PlantOptions options_;
  LcmBus bus_;
  ArmSim sim_;
  std::unique_ptr<View> view_;
  const int64_t source_;

  bool heard_other_ = false;
  bool started_over_ = false;
  Answer answer_ = Answer::kNone;
  int64_t answered_us_ = 0;                   // when, of the host's clock
  int64_t last_session_ = 0, last_seq_ = -1;  // of the command that was answered last

  int64_t status_seq_base_ = 0;  // seq goes on over resets
  int64_t frame_seq_ = 0;
  int64_t truth_seq_ = 0;
  int64_t loop_seq_ = 0, loop_status_us_ = 0;
  int64_t ticks_ = 0, overruns_ = 0, started_us_ = 0;
  float tick_us_ = 0;
  TickStats wakeup_stats_, tick_stats_;  // of the running second
  TickStats wakeup_total_, tick_total_;  // of the whole run
};

}  // namespace intabs
