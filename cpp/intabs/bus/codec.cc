#include "intabs/bus/codec.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <exception>

#include "intabs/bus/messages.h"
#include "intabs_lcm/estop_t.hpp"
#include "intabs_lcm/hand_keypoints_t.hpp"
#include "intabs_lcm/hand_points_t.hpp"
#include "intabs_lcm/lite6_command_t.hpp"
#include "intabs_lcm/lite6_status_t.hpp"
#include "intabs_lcm/loop_status_t.hpp"
#include "intabs_lcm/object_poses_t.hpp"
#include "intabs_lcm/perception_status_t.hpp"
#include "intabs_lcm/plant_control_t.hpp"
#include "intabs_lcm/plant_truth_t.hpp"
#include "intabs_lcm/reset_t.hpp"
#include "intabs_lcm/skill_plan_t.hpp"
#include "intabs_lcm/skill_control_t.hpp"
#include "intabs_lcm/skill_status_t.hpp"
#include "intabs_lcm/tag_detections_t.hpp"

namespace intabs {
namespace {

// Offsets in a datagram: 8 bytes of fingerprint come first. lcm-gen's decoders trust the length of a string
// and the count of an array (a negative length makes them read gigabytes), so both are checked before a
// decoder sees them.
constexpr size_t kStringAt = 24;           // in every message with a string: after utime and seq
constexpr size_t kPlanCountAt = 36;        // n of skill_plan_t
constexpr size_t kDetectionsCountAt = 40;  // n of tag_detections_t

bool StringIsWhole(const uint8_t* data, size_t size, int max_length) {
  if (size < kStringAt + 5) return false;
  const uint8_t* p = data + kStringAt;
  const uint32_t length =
      uint32_t{p[0]} << 24 | uint32_t{p[1]} << 16 | uint32_t{p[2]} << 8 | p[3];  // with its NUL
  return length >= 1 && length <= static_cast<uint32_t>(max_length) + 1 && size >= kStringAt + 4 + length &&
         p[4 + length - 1] == 0;
}

bool CountIsWithin(const uint8_t* data, size_t size, size_t at, int max) {
  return size > at && data[at] <= max;
}

template <class... T>
bool Finite(const T&... values) {
  return (std::isfinite(values) && ...);
}
template <class A>
bool AllFinite(const A& values) {
  return std::all_of(std::begin(values), std::end(values), [](auto v) { return std::isfinite(v); });
}

void Copy(const JointVector& from, double (&to)[kNumJoints]) {
  Eigen::Map<JointVector>(to, kNumJoints) = from;
}
JointVector Joints(const double (&from)[kNumJoints]) {
  return Eigen::Map<const JointVector>(from, kNumJoints);
}

template <class T>
void CopyPose(const Pose& X, T (&p)[3], T (&q)[4]) {
  for (int i = 0; i < 3; ++i) p[i] = static_cast<T>(X.p[i]);
  const double wxyz[4] = {X.q.w(), X.q.x(), X.q.y(), X.q.z()};
  for (int i = 0; i < 4; ++i) q[i] = static_cast<T>(wxyz[i]);
}
template <class T>
Pose PoseOf(const T (&p)[3], const T (&q)[4]) {
  return {Eigen::Vector3d(p[0], p[1], p[2]), Eigen::Quaterniond(q[0], q[1], q[2], q[3])};
}
// float32 carries seven digits of a quaternion.
bool IsRotation(const Eigen::Quaterniond& q) { return std::abs(q.squaredNorm() - 1.0) < 1e-4; }

// ToLcm fills the generated message, FromLcm returns false for a message that makes no sense.

void ToLcm(const ArmCommand& m, intabs_lcm::lite6_command_t& l) {
  l.utime = m.utime;
  l.seq = m.seq;
  l.session = m.session;
  l.status_seq = m.status_seq;
  l.mode = static_cast<int8_t>(m.mode);
  Copy(m.q_target, l.q_target);
  Copy(m.dq_max, l.dq_max);
  l.gripper_closed = m.gripper_closed;
  l.lifetime_us = m.lifetime_us;
}
bool FromLcm(const intabs_lcm::lite6_command_t& l, ArmCommand& m) {
  m.utime = l.utime;
  m.seq = l.seq;
  m.session = l.session;
  m.status_seq = l.status_seq;
  m.mode = static_cast<ArmMode>(l.mode);
  m.q_target = Joints(l.q_target);
  m.dq_max = Joints(l.dq_max);
  m.gripper_closed = l.gripper_closed != 0;
  m.lifetime_us = l.lifetime_us;
  return true;
}

void ToLcm(const ArmStatus& m, intabs_lcm::lite6_status_t& l) {
  l.utime = m.utime;
  l.seq = m.seq;
  l.source = m.source;
  l.session = m.session;
  Copy(m.q, l.q);
  Copy(m.dq, l.dq);
  Copy(m.q_commanded, l.q_commanded);
  Copy(m.tau, l.tau);
  l.gripper_closed = m.gripper_closed;
  l.gripper_opening = m.gripper_opening;
  l.mode = static_cast<int8_t>(m.mode);
  l.state = static_cast<int8_t>(m.state);
  l.fault = static_cast<int8_t>(m.fault);
  l.vendor_error = m.vendor_error;
  l.last_command_seq = m.last_command_seq;
  l.last_frame_seq = m.last_frame_seq;
  std::copy(m.refused.begin(), m.refused.end(), l.refused);
  l.overruns = m.overruns;
  l.tick_us = m.tick_us;
}
bool FromLcm(const intabs_lcm::lite6_status_t& l, ArmStatus& m) {
  m.utime = l.utime;
  m.seq = l.seq;
  m.source = l.source;
  m.session = l.session;
  m.q = Joints(l.q);
  m.dq = Joints(l.dq);
  m.q_commanded = Joints(l.q_commanded);
  m.tau = Joints(l.tau);
  m.gripper_closed = l.gripper_closed != 0;
  m.gripper_opening = l.gripper_opening;
  m.mode = static_cast<ArmMode>(l.mode);
  m.state = static_cast<ArmState>(l.state);
  m.fault = static_cast<Fault>(l.fault);
  m.vendor_error = l.vendor_error;
  m.last_command_seq = l.last_command_seq;
  m.last_frame_seq = l.last_frame_seq;
  std::copy(std::begin(l.refused), std::end(l.refused), m.refused.begin());
  m.overruns = l.overruns;
  m.tick_us = l.tick_us;
  return m.q.allFinite() && m.dq.allFinite() && m.q_commanded.allFinite() && m.tau.allFinite() &&
         Finite(m.gripper_opening, m.tick_us);
}

void ToLcm(const ObjectPoses& m, intabs_lcm::object_poses_t& l) {
  l.utime = m.utime;
  l.exposure_utime = m.exposure_utime;
  l.seq = m.seq;
  l.frame_seq = m.frame_seq;
  for (int i = 0; i < kMaxObjects; ++i) {
    const TrackedObject& o = m.objects[i];
    l.id[i] = o.id;
    CopyPose(o.X_WO, l.p_WO[i], l.q_WO[i]);
    std::copy(o.covariance.begin(), o.covariance.end(), l.covariance[i]);
    l.cameras[i] = o.cameras;
    l.valid[i] = o.valid;
    l.age[i] = o.age;
  }
}
bool FromLcm(const intabs_lcm::object_poses_t& l, ObjectPoses& m) {
  m.utime = l.utime;
  m.exposure_utime = l.exposure_utime;
  m.seq = l.seq;
  m.frame_seq = l.frame_seq;
  for (int i = 0; i < kMaxObjects; ++i) {
    TrackedObject& o = m.objects[i];
    o.id = l.id[i];
    o.X_WO = PoseOf(l.p_WO[i], l.q_WO[i]);
    std::copy(std::begin(l.covariance[i]), std::end(l.covariance[i]), o.covariance.begin());
    o.cameras = l.cameras[i];
    o.valid = l.valid[i] != 0;
    o.age = l.age[i];
    if (!o.X_WO.IsFinite() || !IsRotation(o.X_WO.q) || !AllFinite(o.covariance) || !Finite(o.age))
      return false;
  }
  return true;
}

void ToLcm(const PlantTruth& m, intabs_lcm::plant_truth_t& l) {
  l.utime = m.utime;
  l.seq = m.seq;
  l.frame_seq = m.frame_seq;
  for (int i = 0; i < kMaxObjects; ++i) {
    l.id[i] = m.objects[i].id;
    CopyPose(m.objects[i].X_WO, l.p_WO[i], l.q_WO[i]);
  }
  l.subgoals = static_cast<int32_t>(m.subgoals);
  l.success = m.success;
  l.state_hash = static_cast<int64_t>(m.state_hash);
  std::copy(m.touches.begin(), m.touches.end(), l.touches);
  std::copy(m.beads_in.begin(), m.beads_in.end(), l.beads_in);
  l.beads = m.beads;
}
// What the plant says of an object is exact and new, which the message does not repeat: valid, age 0, no
// covariance.
bool FromLcm(const intabs_lcm::plant_truth_t& l, PlantTruth& m) {
  m.utime = l.utime;
  m.seq = l.seq;
  m.frame_seq = l.frame_seq;
  for (int i = 0; i < kMaxObjects; ++i) {
    m.objects[i] = TrackedObject{};
    m.objects[i].id = l.id[i];
    m.objects[i].X_WO = PoseOf(l.p_WO[i], l.q_WO[i]);
    m.objects[i].valid = l.id[i] >= 0;
    if (!m.objects[i].X_WO.IsFinite() || !IsRotation(m.objects[i].X_WO.q)) return false;
  }
  m.subgoals = static_cast<uint32_t>(l.subgoals);
  m.success = l.success != 0;
  m.state_hash = static_cast<uint64_t>(l.state_hash);
  std::copy(std::begin(l.touches), std::end(l.touches), m.touches.begin());
  std::copy(std::begin(l.beads_in), std::end(l.beads_in), m.beads_in.begin());
  m.beads = l.beads;
  return true;
}

void ToLcm(const TagDetections& m, intabs_lcm::tag_detections_t& l) {
  l.utime = m.utime;
  l.exposure_utime = m.exposure_utime;
  l.seq = m.seq;
  l.frame_seq = m.frame_seq;
  l.n = static_cast<int8_t>(std::clamp(m.n, 0, kMaxTags));
  l.tags.resize(l.n);
  for (int i = 0; i < l.n; ++i) {
    const TagDetection& t = m.tags[i];
    auto& lt = l.tags[i];
    lt.id = t.id;
    for (int c = 0; c < 4; ++c) {
      lt.corners[c][0] = t.corners[c].x();
      lt.corners[c][1] = t.corners[c].y();
    }
    for (int h = 0; h < 2; ++h) {
      CopyPose(t.X_CT[h], lt.p_CT[h], lt.q_CT[h]);
      lt.reprojection_px[h] = t.reprojection_px[h];
    }
    lt.ambiguity = t.ambiguity;
    lt.decision_margin = t.decision_margin;
  }
}
bool FromLcm(const intabs_lcm::tag_detections_t& l, TagDetections& m) {
  m.utime = l.utime;
  m.exposure_utime = l.exposure_utime;
  m.seq = l.seq;
  m.frame_seq = l.frame_seq;
  m.n = l.n;
  for (int i = 0; i < m.n; ++i) {
    const auto& lt = l.tags[i];
    TagDetection& t = m.tags[i];
    t.id = lt.id;
    for (int c = 0; c < 4; ++c) t.corners[c] = {lt.corners[c][0], lt.corners[c][1]};
    for (int h = 0; h < 2; ++h) {
      t.X_CT[h] = PoseOf(lt.p_CT[h], lt.q_CT[h]);
      if (!t.X_CT[h].IsFinite() || !IsRotation(t.X_CT[h].q)) return false;
      t.X_CT[h].q.normalize();  // from float32
      t.reprojection_px[h] = lt.reprojection_px[h];
    }
    t.ambiguity = lt.ambiguity;
    t.decision_margin = lt.decision_margin;
    if (!std::all_of(t.corners.begin(), t.corners.end(), [](const auto& c) { return c.allFinite(); }) ||
        !AllFinite(t.reprojection_px) || !Finite(t.ambiguity, t.decision_margin)) {
      return false;
    }
  }
  return true;
}

void ToLcm(const SkillPlan& m, intabs_lcm::skill_plan_t& l) {
  l.utime = m.utime;
  l.seq = m.seq;
  l.plan_id = m.plan_id;
  l.part = static_cast<int16_t>(m.part);
  l.parts = static_cast<int16_t>(m.parts);
  l.n = static_cast<int8_t>(std::clamp(m.n, 0, kMaxSkillsPerPart));
  l.skills.resize(l.n);
  for (int i = 0; i < l.n; ++i) {
    std::copy(m.skills[i].z.begin(), m.skills[i].z.end(), l.skills[i].z);
    l.skills[i].library_index = m.skills[i].library_index;
    l.skills[i].min_ticks = m.skills[i].min_ticks;
    l.skills[i].max_ticks = m.skills[i].max_ticks;
  }
}
bool FromLcm(const intabs_lcm::skill_plan_t& l, SkillPlan& m) {
  m.utime = l.utime;
  m.seq = l.seq;
  m.plan_id = l.plan_id;
  m.part = l.part;
  m.parts = l.parts;
  m.n = l.n;
  if (m.part < 0 || m.part >= m.parts) return false;
  for (int i = 0; i < m.n; ++i) {
    std::copy(std::begin(l.skills[i].z), std::end(l.skills[i].z), m.skills[i].z.begin());
    m.skills[i].library_index = l.skills[i].library_index;
    m.skills[i].min_ticks = l.skills[i].min_ticks;
    m.skills[i].max_ticks = l.skills[i].max_ticks;
    if (!m.skills[i].z.allFinite()) return false;
  }
  return true;
}

void ToLcm(const SkillStatus& m, intabs_lcm::skill_status_t& l) {
  l.utime = m.utime;
  l.seq = m.seq;
  l.plan_id = m.plan_id;
  l.skill_index = m.skill_index;
  l.n_skills = m.n_skills;
  l.progress = m.progress;
  l.b_probability = m.b_probability;
  l.infer_us = m.infer_us;
  l.end_reason = m.end_reason;
  l.skill_end = m.skill_end;
  l.retries = m.retries;
}
bool FromLcm(const intabs_lcm::skill_status_t& l, SkillStatus& m) {
  m.utime = l.utime;
  m.seq = l.seq;
  m.plan_id = l.plan_id;
  m.skill_index = l.skill_index;
  m.n_skills = l.n_skills;
  m.progress = l.progress;
  m.b_probability = l.b_probability;
  m.infer_us = l.infer_us;
  m.end_reason = l.end_reason;
  m.skill_end = l.skill_end;
  m.retries = l.retries;
  return Finite(m.progress, m.b_probability, m.infer_us);
}

void ToLcm(const SkillControl& m, intabs_lcm::skill_control_t& l) {
  l.utime = m.utime;
  l.seq = m.seq;
  l.plan_id = m.plan_id;
  l.action = m.action;
}
bool FromLcm(const intabs_lcm::skill_control_t& l, SkillControl& m) {
  m.utime = l.utime;
  m.seq = l.seq;
  m.plan_id = l.plan_id;
  m.action = l.action;
  return m.action >= SkillControl::kResume && m.action <= SkillControl::kAbort;
}

void ToLcm(const LoopStatus& m, intabs_lcm::loop_status_t& l) {
  l.utime = m.utime;
  l.seq = m.seq;
  l.name = m.name.substr(0, kMaxLoopName);
  l.ticks = m.ticks;
  l.overruns = m.overruns;
  l.rate_hz = m.rate_hz;
  std::copy(m.wakeup_us.begin(), m.wakeup_us.end(), l.wakeup_us);
  std::copy(m.tick_us.begin(), m.tick_us.end(), l.tick_us);
  std::copy(m.infer_us.begin(), m.infer_us.end(), l.infer_us);
  l.allocations = m.allocations;
}
bool FromLcm(const intabs_lcm::loop_status_t& l, LoopStatus& m) {
  m.utime = l.utime;
  m.seq = l.seq;
  m.name = l.name;
  m.ticks = l.ticks;
  m.overruns = l.overruns;
  m.rate_hz = l.rate_hz;
  std::copy(std::begin(l.wakeup_us), std::end(l.wakeup_us), m.wakeup_us.begin());
  std::copy(std::begin(l.tick_us), std::end(l.tick_us), m.tick_us.begin());
  std::copy(std::begin(l.infer_us), std::end(l.infer_us), m.infer_us.begin());
  m.allocations = l.allocations;
  return Finite(m.rate_hz) && AllFinite(m.wakeup_us) && AllFinite(m.tick_us) && AllFinite(m.infer_us);
}

void ToLcm(const PerceptionStatus& m, intabs_lcm::perception_status_t& l) {
  l.utime = m.utime;
  l.seq = m.seq;
  l.n = static_cast<int8_t>(std::clamp(m.n, 0, kMaxCameras));
  std::copy(m.frames.begin(), m.frames.end(), l.frames);
  std::copy(m.dropped.begin(), m.dropped.end(), l.dropped);
  std::copy(m.late.begin(), m.late.end(), l.late);
  std::copy(m.doubled.begin(), m.doubled.end(), l.doubled);
  std::copy(m.torn.begin(), m.torn.end(), l.torn);
  std::copy(m.fps.begin(), m.fps.end(), l.fps);
  std::copy(m.detect_us_p50.begin(), m.detect_us_p50.end(), l.detect_us_p50);
  std::copy(m.detect_us_p95.begin(), m.detect_us_p95.end(), l.detect_us_p95);
}
bool FromLcm(const intabs_lcm::perception_status_t& l, PerceptionStatus& m) {
  m.utime = l.utime;
  m.seq = l.seq;
  m.n = l.n;
  std::copy(std::begin(l.frames), std::end(l.frames), m.frames.begin());
  std::copy(std::begin(l.dropped), std::end(l.dropped), m.dropped.begin());
  std::copy(std::begin(l.late), std::end(l.late), m.late.begin());
  std::copy(std::begin(l.doubled), std::end(l.doubled), m.doubled.begin());
  std::copy(std::begin(l.torn), std::end(l.torn), m.torn.begin());
  std::copy(std::begin(l.fps), std::end(l.fps), m.fps.begin());
  std::copy(std::begin(l.detect_us_p50), std::end(l.detect_us_p50), m.detect_us_p50.begin());
  std::copy(std::begin(l.detect_us_p95), std::end(l.detect_us_p95), m.detect_us_p95.begin());
  return m.n >= 0 && m.n <= kMaxCameras && AllFinite(m.fps) && AllFinite(m.detect_us_p50) &&
         AllFinite(m.detect_us_p95);
}

void ToLcm(const HandKeypoints& m, intabs_lcm::hand_keypoints_t& l) {
  l.utime = m.utime;
  l.exposure_utime = m.exposure_utime;
  l.seq = m.seq;
  l.frame_seq = m.frame_seq;
  for (int i = 0; i < kNumHandPoints; ++i) std::copy(m.uv[i].begin(), m.uv[i].end(), l.uv[i]);
  l.score = m.score;
}
bool FromLcm(const intabs_lcm::hand_keypoints_t& l, HandKeypoints& m) {
  m.utime = l.utime;
  m.exposure_utime = l.exposure_utime;
  m.seq = l.seq;
  m.frame_seq = l.frame_seq;
  m.score = l.score;
  for (int i = 0; i < kNumHandPoints; ++i) {
    std::copy(std::begin(l.uv[i]), std::end(l.uv[i]), m.uv[i].begin());
    if (!AllFinite(m.uv[i])) return false;
  }
  return Finite(m.score);
}

void ToLcm(const TrackedHand& m, intabs_lcm::hand_points_t& l) {
  l.utime = m.utime;
  l.exposure_utime = m.exposure_utime;
  l.seq = m.seq;
  l.frame_seq = m.frame_seq;
  for (int i = 0; i < kNumHandPoints; ++i) std::copy(m.p_W[i].begin(), m.p_W[i].end(), l.p_W[i]);
  std::copy(m.sigma.begin(), m.sigma.end(), l.sigma);
  std::copy(m.state.begin(), m.state.end(), l.state);
  l.score = m.score;
}
bool FromLcm(const intabs_lcm::hand_points_t& l, TrackedHand& m) {
  m.utime = l.utime;
  m.exposure_utime = l.exposure_utime;
  m.seq = l.seq;
  m.frame_seq = l.frame_seq;
  m.score = l.score;
  for (int i = 0; i < kNumHandPoints; ++i) {
    std::copy(std::begin(l.p_W[i]), std::end(l.p_W[i]), m.p_W[i].begin());
    if (!AllFinite(m.p_W[i])) return false;
  }
  std::copy(std::begin(l.sigma), std::end(l.sigma), m.sigma.begin());
  std::copy(std::begin(l.state), std::end(l.state), m.state.begin());
  return AllFinite(m.sigma) && Finite(m.score);
}

void ToLcm(const PlantControl& m, intabs_lcm::plant_control_t& l) {
  l.utime = m.utime;
  l.seq = m.seq;
  l.task = m.task.substr(0, kMaxTaskName);
  l.seed = m.seed;
  l.spread = m.spread;
  l.reset = m.reset;
}
bool FromLcm(const intabs_lcm::plant_control_t& l, PlantControl& m) {
  m.utime = l.utime;
  m.seq = l.seq;
  m.task = l.task;
  m.seed = l.seed;
  m.spread = l.spread;
  m.reset = l.reset != 0;
  return Finite(m.spread);
}

void ToLcm(const Estop& m, intabs_lcm::estop_t& l) {
  l.utime = m.utime;
  l.seq = m.seq;
  l.reason = m.reason.substr(0, kMaxReason);
}
bool FromLcm(const intabs_lcm::estop_t& l, Estop& m) {
  m.utime = l.utime;
  m.seq = l.seq;
  m.reason = l.reason;
  return true;
}

void ToLcm(const Reset& m, intabs_lcm::reset_t& l) {
  l.utime = m.utime;
  l.seq = m.seq;
  l.session = m.session;
}
bool FromLcm(const intabs_lcm::reset_t& l, Reset& m) {
  m.utime = l.utime;
  m.seq = l.seq;
  m.session = l.session;
  return true;
}

// Which generated message carries a struct, and what must hold of the bytes before lcm-gen's decoder may see
// them.
template <class M>
struct Wire;
template <class L>
struct PlainWire {
  using Message = L;
  static bool IsSafe(const uint8_t*, size_t) { return true; }
};
template <class L, int max_length>
struct StringWire {
  using Message = L;
  static bool IsSafe(const uint8_t* data, size_t size) { return StringIsWhole(data, size, max_length); }
};
template <class L, size_t at, int max>
struct CountWire {
  using Message = L;
  static bool IsSafe(const uint8_t* data, size_t size) { return CountIsWithin(data, size, at, max); }
};
template <>
struct Wire<ArmCommand> : PlainWire<intabs_lcm::lite6_command_t> {};
template <>
struct Wire<ArmStatus> : PlainWire<intabs_lcm::lite6_status_t> {};
template <>
struct Wire<ObjectPoses> : PlainWire<intabs_lcm::object_poses_t> {};
template <>
struct Wire<PlantTruth> : PlainWire<intabs_lcm::plant_truth_t> {};
template <>
struct Wire<SkillStatus> : PlainWire<intabs_lcm::skill_status_t> {};
template <>
struct Wire<SkillControl> : PlainWire<intabs_lcm::skill_control_t> {};
template <>
struct Wire<PerceptionStatus> : PlainWire<intabs_lcm::perception_status_t> {};
template <>
struct Wire<HandKeypoints> : PlainWire<intabs_lcm::hand_keypoints_t> {};
template <>
struct Wire<TrackedHand> : PlainWire<intabs_lcm::hand_points_t> {};
template <>
struct Wire<Reset> : PlainWire<intabs_lcm::reset_t> {};
template <>
struct Wire<TagDetections> : CountWire<intabs_lcm::tag_detections_t, kDetectionsCountAt, kMaxTags> {};
template <>
struct Wire<SkillPlan> : CountWire<intabs_lcm::skill_plan_t, kPlanCountAt, kMaxSkillsPerPart> {};
template <>
struct Wire<LoopStatus> : StringWire<intabs_lcm::loop_status_t, kMaxLoopName> {};
template <>
struct Wire<PlantControl> : StringWire<intabs_lcm::plant_control_t, kMaxTaskName> {};
template <>
struct Wire<Estop> : StringWire<intabs_lcm::estop_t, kMaxReason> {};

}  // namespace

template <class M>
int Encode(const M& m, uint8_t* out) {
  typename Wire<M>::Message l{};
  ToLcm(m, l);
  return l.encode(out, 0, kMaxMessageBytes);
}

template <class M>
bool Decode(const uint8_t* data, size_t size, M& m) noexcept {
  if (size > kMaxMessageBytes || !Wire<M>::IsSafe(data, size)) return false;
  typename Wire<M>::Message l{};
  return l.decode(data, 0, static_cast<int>(size)) == static_cast<int>(size) && FromLcm(l, m);
}

#define INTABS_MESSAGE(M)                  \
  template int Encode(const M&, uint8_t*); \
  template bool Decode(const uint8_t*, size_t, M&) noexcept;
INTABS_MESSAGE(ArmCommand)
INTABS_MESSAGE(ArmStatus)
INTABS_MESSAGE(ObjectPoses)
INTABS_MESSAGE(PlantTruth)
INTABS_MESSAGE(TagDetections)
INTABS_MESSAGE(SkillPlan)
INTABS_MESSAGE(SkillStatus)
INTABS_MESSAGE(SkillControl)
INTABS_MESSAGE(LoopStatus)
INTABS_MESSAGE(PerceptionStatus)
INTABS_MESSAGE(HandKeypoints)
INTABS_MESSAGE(TrackedHand)
INTABS_MESSAGE(PlantControl)
INTABS_MESSAGE(Estop)
INTABS_MESSAGE(Reset)
#undef INTABS_MESSAGE

}  // namespace intabs
