// What the controller pushes on its report ports, without being asked. Pure, noexcept. Layouts: xarm-python-sdk 1.18.4
// (x3/report.py) and ufactory_docs p08..p11.
//
//   port 30003 "real"    100 Hz   87 or 135 bytes   state, positions, torques
//   port 30001 "normal"    5 Hz  145 (old: 133)     and errors, brakes, payload
//   port 30002 "rich"      5 Hz  233 and more       and speeds, temperatures, currents ...
//   port 30000 "full"    250 Hz  784 and more       targets and measurements with speeds; firmware 2.1.0 and later
// A frame begins with its size (u32be), and the size tells its kind: it depends on the firmware, not on the port alone.
#pragma once

#include <cstddef>
#include <cstdint>

#include "intabs/core/types.h"
#include "intabs/lite6/wire.h"

namespace intabs::lite6 {

enum class ReportKind : uint8_t { kReal, kNormal, kRich, kFull };

struct ArmReport {
  ReportKind kind = ReportKind::kReal;
  VendorMode mode = VendorMode::kPosition;
  VendorState state = VendorState::kStopped;
  int queued = 0;                           // commands
  JointVector q = JointVector::Zero();      // [rad]
  JointVector tau = JointVector::Zero();    // estimated [Nm]
  bool has_dq = false;                      // kFull alone; kRich has a target's speed, which is not a measurement
  JointVector dq = JointVector::Zero();     // [rad/s]
  bool has_errors = false;                  // kNormal and kRich
  int error = 0, warning = 0;
  uint8_t enabled = 0, brakes = 0;          // bit i: joint i + 1
};

inline constexpr size_t kMaxReportBytes = 2048;

// Looks at the beginning of a stream. kBroken: a size no firmware has, or a number no arm has (mode over 11, state over
// 9, sensitivity over 5, joints not finite or absurd): what follows cannot be trusted either, reconnect. `report` is
// filled for kFrame alone. Reads no byte outside [data, data + size).
[[nodiscard]] Parsed ParseReport(const uint8_t* data, size_t size, ArmReport& report, size_t& used) noexcept;

// The other direction, for the fake controller. Writes kMaxReportBytes at most, returns the size.
int EncodeReport(const ArmReport& report, int64_t time_us, const JointVector& q_target, uint8_t* out) noexcept;

}  // namespace intabs::lite6
