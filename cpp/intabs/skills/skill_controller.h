// One policy tick from messages to message: LITE6_STATUS + OBJECT_POSES -> LITE6_COMMAND. The same object runs in the
// process intabs_control and in in-process rollouts, so both give the same trajectory.
#pragma once

#include "intabs/skills/skill_player.h"

namespace intabs {

inline constexpr int64_t kMaxPoseAgeUs = 500000;   // with older object poses the arm holds and the plan waits ...
inline constexpr int64_t kPosesGoneUs = 2500000;   // ... and from here on it ends: perception is gone

class SkillController {
 public:
  // session: random, > 0; names this controller to the driver.
  SkillController(SkillPlayer player, int64_t session) : player_(std::move(player)), session_(session) {}

  Status Start(int64_t plan_id, std::span<const Skill> skills) noexcept {
    paused_ = false;
    return player_.Start(plan_id, skills);
  }
  void Abort(EndReason why) noexcept { player_.Abort(why); }
  // While paused the arm holds and the plan waits.
  void Pause(bool on) noexcept { paused_ = on; }

  // Real-time safe. Always fills a command that is safe to send: while nothing is played it asks the driver to hold.
  // Returns what the player said. While poses are older than kMaxPoseAgeUs the arm is asked to hold and the plan waits
  // (kNotReady). Ends the plan (see PlayerStatus) when they are older than kPosesGoneUs, or if the driver is in fault,
  // stopped, or obeys another session.
  Status Tick(const ArmStatus& status, const ObjectPoses& poses, ArmCommand& command) noexcept;

  SkillPlayer& player() noexcept { return player_; }
  const SkillPlayer& player() const noexcept { return player_; }
  int64_t session() const noexcept { return session_; }

 private:
  SkillPlayer player_;
  int64_t session_;
  int64_t seq_ = 0;
  bool gripper_closed_ = false;
  bool paused_ = false;
};

}  // namespace intabs
