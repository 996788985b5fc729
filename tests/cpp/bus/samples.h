// One message of each kind at its largest, every field different, and field-wise comparison.
#pragma once

#include <string>

#include "intabs/bus/bus.h"

namespace intabs::samples {

// A source of numbers that never repeats.
struct Counter {
  double n = 0;
  double operator()() { return n += 1.25; }
  int64_t Int() { return (int64_t{1} << 40) + static_cast<int64_t>(n += 1); }
  JointVector Joints() {
    return JointVector::NullaryExpr([this] { return (*this)(); });
  }
  // Quarter turns have coefficients that float32 holds exactly.
  Pose ExactPose() {
    Pose X;
    for (int i = 0; i < 3; ++i) X.p[i] = (*this)();
    X.q = Eigen::Quaterniond(0.5, -0.5, 0.5, -0.5);
    return X;
  }
};

template <class M>
M Head(Counter& c) {
  M m;
  m.utime = c.Int();
  m.seq = c.Int();
  return m;
}

inline TrackedObject Object(Counter& c) {
  TrackedObject o;
  o.id = static_cast<int32_t>(c());
  o.X_WO = c.ExactPose();
  for (float& v : o.covariance) v = static_cast<float>(c());
  o.cameras = 3;
  o.valid = true;
  o.age = static_cast<float>(c());
  return o;
}

template <class M>
M Largest();

template <>
inline ArmCommand Largest() {
  Counter c;
  auto m = Head<ArmCommand>(c);
  m.session = c.Int();
  m.status_seq = c.Int();
  m.mode = ArmMode::kServo;
  m.q_target = c.Joints();
  m.dq_max = c.Joints();
  m.gripper_closed = true;
  m.lifetime_us = c.Int();
  return m;
}
inline bool Same(const ArmCommand& a, const ArmCommand& b) {
  return a.utime == b.utime && a.seq == b.seq && a.session == b.session && a.status_seq == b.status_seq &&
         a.mode == b.mode && a.q_target == b.q_target && a.dq_max == b.dq_max &&
         a.gripper_closed == b.gripper_closed && a.lifetime_us == b.lifetime_us;
}

template <>
inline ArmStatus Largest() {
  Counter c;
  auto m = Head<ArmStatus>(c);
  m.source = c.Int();
  m.session = c.Int();
  m.q = c.Joints();
  m.dq = c.Joints();
  m.q_commanded = c.Joints();
  m.tau = c.Joints();
  m.gripper_closed = true;
  m.gripper_opening = c();
  m.mode = ArmMode::kServo;
  m.state = ArmState::kStopped;
  m.fault = Fault::kEstop;
  m.vendor_error = 60;
  m.last_command_seq = c.Int();
  m.last_frame_seq = c.Int();
  for (int32_t& r : m.refused) r = static_cast<int32_t>(c());
  m.overruns = 77;
  m.tick_us = static_cast<float>(c());
  return m;
}
inline bool Same(const ArmStatus& a, const ArmStatus& b) {
  return a.utime == b.utime && a.seq == b.seq && a.source == b.source && a.session == b.session &&
         a.q == b.q && a.dq == b.dq && a.q_commanded == b.q_commanded && a.tau == b.tau &&
         a.gripper_closed == b.gripper_closed && a.gripper_opening == b.gripper_opening && a.mode == b.mode &&
         a.state == b.state && a.fault == b.fault && a.vendor_error == b.vendor_error &&
         a.last_command_seq == b.last_command_seq && a.last_frame_seq == b.last_frame_seq &&
         a.refused == b.refused && a.overruns == b.overruns && a.tick_us == b.tick_us;
}

inline bool Same(const Pose& a, const Pose& b) { return a.p == b.p && a.q.coeffs() == b.q.coeffs(); }

template <>
inline ObjectPoses Largest() {
  Counter c;
  auto m = Head<ObjectPoses>(c);
  m.exposure_utime = c.Int();
  m.frame_seq = c.Int();
  for (auto& o : m.objects) o = Object(c);
  return m;
}
inline bool Same(const ObjectPoses& a, const ObjectPoses& b) {
  bool same = a.utime == b.utime && a.seq == b.seq && a.exposure_utime == b.exposure_utime &&
              a.frame_seq == b.frame_seq;
  for (int i = 0; i < kMaxObjects; ++i) {
    const auto &x = a.objects[i], &y = b.objects[i];
    same = same && x.id == y.id && Same(x.X_WO, y.X_WO) && x.covariance == y.covariance &&
           x.cameras == y.cameras && x.valid == y.valid && x.age == y.age;
  }
  return same;
}

template <>
inline PlantTruth Largest() {
  Counter c;
  auto m = Head<PlantTruth>(c);
  m.frame_seq = c.Int();
  for (auto& o : m.objects) o = Object(c);
  m.subgoals = 0xffffffff;
  m.success = true;
  m.state_hash = 0xfedcba9876543210;
  m.touches = {0x81, 0x42, 0x24, 0x18};
  m.beads_in = {1, -2, 3, 0x7fff};
  m.beads = 30;
  return m;
}
inline bool Same(const PlantTruth& a, const PlantTruth& b) {
  bool same = a.utime == b.utime && a.seq == b.seq && a.frame_seq == b.frame_seq &&
              a.subgoals == b.subgoals && a.success == b.success && a.state_hash == b.state_hash &&
              a.touches == b.touches && a.beads_in == b.beads_in && a.beads == b.beads;
  for (int i = 0; i < kMaxObjects; ++i) {
    same = same && a.objects[i].id == b.objects[i].id && Same(a.objects[i].X_WO, b.objects[i].X_WO) &&
           b.objects[i].valid;
  }
  return same;
}

template <>
inline TagDetections Largest() {
  Counter c;
  auto m = Head<TagDetections>(c);
  m.exposure_utime = c.Int();
  m.frame_seq = c.Int();
  m.n = kMaxTags;
  for (auto& t : m.tags) {
    t.id = static_cast<int32_t>(c());
    for (auto& corner : t.corners) corner = {static_cast<float>(c()), static_cast<float>(c())};
    for (auto& X : t.X_CT) X = c.ExactPose();
    for (auto& r : t.reprojection_px) r = static_cast<float>(c());
    t.ambiguity = static_cast<float>(c());
    t.decision_margin = static_cast<float>(c());
  }
  return m;
}
inline bool Same(const TagDetections& a, const TagDetections& b) {
  bool same = a.utime == b.utime && a.seq == b.seq && a.exposure_utime == b.exposure_utime &&
              a.frame_seq == b.frame_seq && a.n == b.n;
  for (int i = 0; i < a.n; ++i) {
    const auto &x = a.tags[i], &y = b.tags[i];
    same = same && x.id == y.id && x.corners == y.corners && Same(x.X_CT[0], y.X_CT[0]) &&
           Same(x.X_CT[1], y.X_CT[1]) && x.reprojection_px == y.reprojection_px &&
           x.ambiguity == y.ambiguity && x.decision_margin == y.decision_margin;
  }
  return same;
}

template <>
inline HandKeypoints Largest() {
  Counter c;
  auto m = Head<HandKeypoints>(c);
  m.exposure_utime = c.Int();
  m.frame_seq = c.Int();
  for (auto& uv : m.uv) uv = {static_cast<float>(c()), static_cast<float>(c())};
  m.score = static_cast<float>(c());
  return m;
}
inline bool Same(const HandKeypoints& a, const HandKeypoints& b) {
  return a.utime == b.utime && a.seq == b.seq && a.exposure_utime == b.exposure_utime &&
         a.frame_seq == b.frame_seq && a.uv == b.uv && a.score == b.score;
}

template <>
inline TrackedHand Largest() {
  Counter c;
  auto m = Head<TrackedHand>(c);
  m.exposure_utime = c.Int();
  m.frame_seq = c.Int();
  for (auto& p : m.p_W) p = {static_cast<float>(c()), static_cast<float>(c()), static_cast<float>(c())};
  for (float& s : m.sigma) s = static_cast<float>(c());
  for (size_t i = 0; i < m.state.size(); ++i) m.state[i] = static_cast<uint8_t>(i + 1);
  m.score = static_cast<float>(c());
  return m;
}
inline bool Same(const TrackedHand& a, const TrackedHand& b) {
  return a.utime == b.utime && a.seq == b.seq && a.exposure_utime == b.exposure_utime &&
         a.frame_seq == b.frame_seq && a.p_W == b.p_W && a.sigma == b.sigma && a.state == b.state &&
         a.score == b.score;
}

template <>
inline SkillPlan Largest() {
  Counter c;
  auto m = Head<SkillPlan>(c);
  m.plan_id = c.Int();
  m.part = 998;
  m.parts = 999;
  m.n = kMaxSkillsPerPart;
  for (auto& s : m.skills) {
    s.z = LatentVector::NullaryExpr([&c] { return static_cast<float>(c()); });
    s.library_index = static_cast<int32_t>(c());
    s.min_ticks = static_cast<int32_t>(c());
    s.max_ticks = static_cast<int32_t>(c());
  }
  return m;
}
inline bool Same(const SkillPlan& a, const SkillPlan& b) {
  bool same = a.utime == b.utime && a.seq == b.seq && a.plan_id == b.plan_id && a.part == b.part &&
              a.parts == b.parts && a.n == b.n;
  for (int i = 0; i < a.n; ++i) {
    const auto &x = a.skills[i], &y = b.skills[i];
    same = same && x.z == y.z && x.library_index == y.library_index && x.min_ticks == y.min_ticks &&
           x.max_ticks == y.max_ticks;
  }
  return same;
}

template <>
inline SkillStatus Largest() {
  Counter c;
  auto m = Head<SkillStatus>(c);
  m.plan_id = c.Int();
  m.skill_index = 5;
  m.n_skills = 6;
  m.progress = 0.25F;
  m.b_probability = 0.5F;
  m.infer_us = 123.0F;
  m.end_reason = 2;
  m.skill_end = 1;
  m.retries = 3;
  return m;
}
inline bool Same(const SkillStatus& a, const SkillStatus& b) {
  return a.utime == b.utime && a.seq == b.seq && a.plan_id == b.plan_id && a.skill_index == b.skill_index &&
         a.n_skills == b.n_skills && a.progress == b.progress && a.b_probability == b.b_probability &&
         a.infer_us == b.infer_us && a.end_reason == b.end_reason && a.skill_end == b.skill_end && a.retries == b.retries;
}

template <>
inline SkillControl Largest() {
  Counter c;
  auto m = Head<SkillControl>(c);
  m.plan_id = c.Int();
  m.action = SkillControl::kAbort;
  return m;
}
inline bool Same(const SkillControl& a, const SkillControl& b) {
  return a.utime == b.utime && a.seq == b.seq && a.plan_id == b.plan_id && a.action == b.action;
}

template <>
inline LoopStatus Largest() {
  Counter c;
  auto m = Head<LoopStatus>(c);
  m.name = std::string(kMaxLoopName, 'n');
  m.ticks = c.Int();
  m.overruns = c.Int();
  m.rate_hz = 250;
  m.wakeup_us = {1, 2, 3};
  m.tick_us = {4, 5, 6};
  m.infer_us = {7, 8};
  m.allocations = c.Int();
  return m;
}
inline bool Same(const LoopStatus& a, const LoopStatus& b) {
  return a.utime == b.utime && a.seq == b.seq && a.name == b.name && a.ticks == b.ticks &&
         a.overruns == b.overruns && a.rate_hz == b.rate_hz && a.wakeup_us == b.wakeup_us &&
         a.tick_us == b.tick_us && a.infer_us == b.infer_us && a.allocations == b.allocations;
}

template <>
inline PerceptionStatus Largest() {
  Counter c;
  auto m = Head<PerceptionStatus>(c);
  m.n = kMaxCameras;
  for (int i = 0; i < kMaxCameras; ++i) {
    m.frames[i] = c.Int();
    m.dropped[i] = c.Int();
    m.late[i] = c.Int();
    m.doubled[i] = c.Int();
    m.torn[i] = c.Int();
    m.fps[i] = static_cast<float>(c());
    m.detect_us_p50[i] = static_cast<float>(c());
    m.detect_us_p95[i] = static_cast<float>(c());
  }
  return m;
}
inline bool Same(const PerceptionStatus& a, const PerceptionStatus& b) {
  return a.utime == b.utime && a.seq == b.seq && a.n == b.n && a.frames == b.frames &&
         a.dropped == b.dropped && a.late == b.late && a.doubled == b.doubled && a.torn == b.torn &&
         a.fps == b.fps && a.detect_us_p50 == b.detect_us_p50 && a.detect_us_p95 == b.detect_us_p95;
}

template <>
inline PlantControl Largest() {
  Counter c;
  auto m = Head<PlantControl>(c);
  m.task = std::string(kMaxTaskName, 't');
  m.seed = c.Int();
  m.spread = c();
  m.reset = true;
  return m;
}
inline bool Same(const PlantControl& a, const PlantControl& b) {
  return a.utime == b.utime && a.seq == b.seq && a.task == b.task && a.seed == b.seed &&
         a.spread == b.spread && a.reset == b.reset;
}

template <>
inline Estop Largest() {
  Counter c;
  auto m = Head<Estop>(c);
  m.reason = std::string(kMaxReason, 'r');
  return m;
}
inline bool Same(const Estop& a, const Estop& b) {
  return a.utime == b.utime && a.seq == b.seq && a.reason == b.reason;
}

template <>
inline Reset Largest() {
  Counter c;
  auto m = Head<Reset>(c);
  m.session = c.Int();
  return m;
}
inline bool Same(const Reset& a, const Reset& b) {
  return a.utime == b.utime && a.seq == b.seq && a.session == b.session;
}

}  // namespace intabs::samples
