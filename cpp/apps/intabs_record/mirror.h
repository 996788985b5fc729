// The puppet follows the master: MASTER_LITE6_STATUS + LITE6_STATUS -> LITE6_COMMAND.
#pragma once

#include <cstdint>
#include <optional>

#include "intabs/core/types.h"
#include "intabs/kinematics/arm_model.h"

namespace intabs {

// Pure: time comes in, commands go out. A master that is silent makes the puppet hold; before its first word
// nothing is commanded. When the master speaks, at the start or again, the puppet first closes up slowly.
//
// Wall clock: every status of the puppet is answered with the newest pose of the master.
// Lockstep: a status on the policy's grid is answered when the master's status of the same seq is in: a
// simulated master lives on the puppet's time and numbers what it says by the status it has seen.
class Mirror {
 public:
  static constexpr double kApproachSpeed = 0.5;         // [rad/s], each joint, while closing up
  static constexpr double kTogether = 0.05;             // [rad]: closer than that it follows at full speed
  static constexpr int64_t kSilentUs = 200'000;         // wall clock
  static constexpr int64_t kSilentLockstepUs = 5'000'000;  // half of what the plant waits

  Mirror(bool lockstep, int64_t session) : lockstep_(lockstep), session_(session) {}

  // `now_us` is the host's monotonic clock everywhere.
  void OnMaster(const ArmStatus& master, int64_t now_us);
  void OnPuppet(const ArmStatus& puppet, int64_t now_us);

  // True if `command` is to be sent now. Call after every message and now and then.
  bool Answer(int64_t now_us, ArmCommand& command);

  int64_t answered() const { return answered_; }
  int64_t held() const { return held_; }    // of these, with a hold
  bool silent() const { return silent_; }   // the master, though it has spoken before

 private:

  const bool lockstep_;
  const int64_t session_;
  const ArmModel model_ = ArmModel::Lite6();
  std::optional<ArmStatus> master_;
  int64_t master_heard_us_ = 0;
  std::optional<ArmStatus> waiting_;  // puppet's, to be answered
  int64_t waiting_since_us_ = 0;
  int64_t source_ = 0;  // of the puppet
  ArmCommand last_;     // the answer to last_.status_seq
  bool again_ = false;  // it has not arrived
  bool together_ = false;
  bool silent_ = false;
  int64_t seq_ = 0, answered_ = 0, held_ = 0;
};

}  // namespace intabs
