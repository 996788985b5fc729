// Messages that no room but the apps needs: plans, states of loops, orders to the plant. The shared ones are
// in core/types.h.
#pragma once

#include <array>
#include <cstdint>
#include <string>

#include "intabs/core/types.h"

namespace intabs {

inline constexpr int kMaxSkillsPerPart = 16;
// Longer strings are cut when sent and refused when received.
inline constexpr int kMaxReason = 200;
inline constexpr int kMaxLoopName = 32;
inline constexpr int kMaxTaskName = 64;

// Part `part` of `parts` of a plan; only the first n skills count.
struct SkillPlan {
  struct Skill {
    LatentVector z = LatentVector::Zero();
    int32_t library_index = -1;  // -1: z is given
    int32_t min_ticks = 0;       // of the policy
    int32_t max_ticks = 0;
  };
  int64_t utime = 0;
  int64_t seq = 0;
  int64_t plan_id = 0;
  int part = 0;
  int parts = 1;
  int n = 0;
  std::array<Skill, kMaxSkillsPerPart> skills;
};

struct SkillStatus {
  int64_t utime = 0;
  int64_t seq = 0;
  int64_t plan_id = 0;  // 0: none
  int32_t skill_index = 0;
  int32_t n_skills = 0;
  float progress = 0;       // of the running skill, 0 .. 1
  float b_probability = 0;  // that the running skill ends now
  float infer_us = 0;       // pi alone
  int8_t end_reason = 0;    // skills/skill_player.h EndReason
  int8_t skill_end = 0;     // skills/skill_player.h SkillEnd
  int8_t retries = 0;
};

struct SkillControl {
  static constexpr int8_t kResume = 0, kPause = 1, kAbort = 2;
  int64_t utime = 0;
  int64_t seq = 0;
  int64_t plan_id = 0;  // the one that is meant
  int8_t action = kResume;
};

struct LoopStatus {
  int64_t utime = 0;
  int64_t seq = 0;
  std::string name;
  int64_t ticks = 0;
  int64_t overruns = 0;
  float rate_hz = 0;
  std::array<float, 3> wakeup_us{};  // p50, p99, max
  std::array<float, 3> tick_us{};    // p50, p99, max
  std::array<float, 2> infer_us{};   // p50, p99; policy loops
  int64_t allocations = -1;          // in the tick since the start; -1: not counted
};

// Only the first n cameras count.
struct PerceptionStatus {
  int64_t utime = 0;
  int64_t seq = 0;
  int n = 0;
  std::array<int64_t, kMaxCameras> frames{}, dropped{}, late{}, doubled{}, torn{};
  std::array<float, kMaxCameras> fps{}, detect_us_p50{}, detect_us_p95{};
};

inline constexpr int kNumHandPoints = 21;  // in MediaPipe's order

// What a 2-D estimator found in one picture of one camera.
struct HandKeypoints {
  int64_t utime = 0;
  int64_t exposure_utime = 0;  // of the frame
  int64_t seq = 0;
  int64_t frame_seq = 0;
  std::array<std::array<float, 2>, kNumHandPoints> uv{};  // px; over 2e4: not seen
  float score = 0;
};

struct TrackedHand {
  int64_t utime = 0;           // when it was computed
  int64_t exposure_utime = 0;  // of the frame
  int64_t seq = 0;
  int64_t frame_seq = 0;
  std::array<std::array<float, 3>, kNumHandPoints> p_W{};  // [m]; zero where nothing is known
  std::array<float, kNumHandPoints> sigma{};               // of a coordinate [m]
  std::array<uint8_t, kNumHandPoints> state{};             // perception/hand.h PointState
  float score = 0;                                         // of the key points
};

struct PlantControl {
  int64_t utime = 0;
  int64_t seq = 0;
  std::string task;  // empty: the one that runs
  int64_t seed = 0;
  double spread = 0;  // [cm]
  bool reset = false;
};

struct Estop {
  int64_t utime = 0;
  int64_t seq = 0;
  std::string reason;
};

struct Reset {
  int64_t utime = 0;
  int64_t seq = 0;
  int64_t session = 0;  // the session that may command next
};

}  // namespace intabs
