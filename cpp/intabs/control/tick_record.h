// One driver tick for the flight recorder (rt/flight_recorder.h), and its row in the file.
#pragma once

#include <cstdint>
#include <cstdio>

#include "intabs/core/types.h"

namespace intabs {

// Filled by ArmController::FillRecord but for the measured part, which is the driver's. Trivially copyable.
struct TickRecord {
  int64_t utime = 0;
  int64_t last_command_seq = 0;
  int8_t state = 0, fault = 0, mode = 0;
  bool link_ok = true, blocked = false, halted = false, gripper_closed = false;
  double q_target[kNumJoints] = {}, q_ref[kNumJoints] = {}, dq_ref[kNumJoints] = {}, ddq_ref[kNumJoints] = {};
  int32_t refused = 0;                             // all kinds
  double q[kNumJoints] = {}, dq[kNumJoints] = {};  // measured
  int64_t measured_utime = 0;
  int32_t vendor_error = 0;
  float wakeup_us = 0, tick_us = 0;
};

inline constexpr const char* kTickRecordHeader =
    "utime,last_command_seq,state,fault,mode,link_ok,blocked,halted,gripper_closed,"
    "q_target0,q_target1,q_target2,q_target3,q_target4,q_target5,q_ref0,q_ref1,q_ref2,q_ref3,q_ref4,q_ref5,"
    "dq_ref0,dq_ref1,dq_ref2,dq_ref3,dq_ref4,dq_ref5,ddq_ref0,ddq_ref1,ddq_ref2,ddq_ref3,ddq_ref4,ddq_ref5,"
    "refused,q0,q1,q2,q3,q4,q5,dq0,dq1,dq2,dq3,dq4,dq5,measured_utime,vendor_error,wakeup_us,tick_us";

inline int FormatTickRecord(const TickRecord& r, char* out, size_t size) {
  int n = std::snprintf(out, size, "%lld,%lld,%d,%d,%d,%d,%d,%d,%d", static_cast<long long>(r.utime),
                        static_cast<long long>(r.last_command_seq), r.state, r.fault, r.mode, r.link_ok,
                        r.blocked, r.halted, r.gripper_closed);
  const auto room = [&] { return n < static_cast<int>(size) ? size - static_cast<size_t>(n) : 0; };
  const auto joints = [&](const double* v) {
    for (int i = 0; i < kNumJoints; ++i) n += std::snprintf(out + n, room(), ",%.9g", v[i]);
  };
  joints(r.q_target);
  joints(r.q_ref);
  joints(r.dq_ref);
  joints(r.ddq_ref);
  n += std::snprintf(out + n, room(), ",%d", r.refused);
  joints(r.q);
  joints(r.dq);
  n += std::snprintf(out + n, room(), ",%lld,%d,%.1f,%.1f", static_cast<long long>(r.measured_utime),
                     r.vendor_error, static_cast<double>(r.wakeup_us), static_cast<double>(r.tick_us));
  return n;
}

}  // namespace intabs
