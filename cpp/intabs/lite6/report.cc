#include "intabs/lite6/report.h"

#include <cstring>
#include <optional>

namespace intabs::lite6 {
namespace {

std::optional<ReportKind> KindOf(size_t size) {
  if (size == 87 || size == 135) return ReportKind::kReal;
  if (size == 133 || size == 145) return ReportKind::kNormal;
  if (size >= 233 && size < 784) return ReportKind::kRich;
  if (size >= 784 && size <= kMaxReportBytes) return ReportKind::kFull;
  return std::nullopt;
}

// Bytes of the common head of real, normal and rich: [4] mode and state, [5) queue, [7) q, [59) torque.
constexpr int kState = 4, kQueue = 5, kQ = 7, kTau = 59;
// Normal and rich.
constexpr int kBrakes = 87, kEnabled = 88, kError = 89, kWarning = 90, kCollision = 131, kTeach = 132;
// Full.
constexpr int kFullTime = 4, kFullState = 12, kFullQueue = 13, kFullTarget = 32, kFullQ = 116, kFullDq = 144,
              kFullTau = 228;
constexpr int kMaxMode = 11, kMaxState = 9, kMaxSensitivity = 5;
constexpr size_t kRealBytes = 87, kNormalBytes = 145, kRichBytes = 587, kFullBytes = 804;

}  // namespace

Parsed ParseReport(const uint8_t* data, size_t size, ArmReport& report, size_t& used) noexcept {
  if (size < 4) return Parsed::kMore;
  const size_t bytes = GetU32(data);
  const auto kind = KindOf(bytes);
  if (!kind) return Parsed::kBroken;
  if (size < bytes) return Parsed::kMore;

  const bool full = *kind == ReportKind::kFull;
  ArmReport r;
  r.kind = *kind;
  const uint8_t mode_state = data[full ? kFullState : kState];
  if (mode_state >> 4 > kMaxMode || (mode_state & 15) > kMaxState) return Parsed::kBroken;
  r.mode = static_cast<VendorMode>(mode_state >> 4);
  r.state = static_cast<VendorState>(mode_state & 15);
  r.queued = GetU16(data + (full ? kFullQueue : kQueue));
  if (!GetJointVector(data + (full ? kFullQ : kQ), kSanePosition, r.q)) return Parsed::kBroken;
  if (!GetJointVector(data + (full ? kFullTau : kTau), kSaneTorque, r.tau)) return Parsed::kBroken;
  r.has_dq = full;
  if (full && !GetJointVector(data + kFullDq, kSaneSpeed, r.dq)) return Parsed::kBroken;
  r.has_errors = *kind == ReportKind::kNormal || *kind == ReportKind::kRich;
  if (r.has_errors) {
    if (data[kCollision] > kMaxSensitivity || data[kTeach] > kMaxSensitivity) return Parsed::kBroken;
    r.brakes = data[kBrakes];
    r.enabled = data[kEnabled];
    r.error = data[kError];
    r.warning = data[kWarning];
  }
  report = r;
  used = bytes;
  return Parsed::kFrame;
}

int EncodeReport(const ArmReport& r, int64_t time_us, const JointVector& q_target, uint8_t* out) noexcept {
  size_t bytes = kRealBytes;
  if (r.kind == ReportKind::kNormal) bytes = kNormalBytes;
  if (r.kind == ReportKind::kRich) bytes = kRichBytes;
  if (r.kind == ReportKind::kFull) bytes = kFullBytes;
  std::memset(out, 0, bytes);
  PutU32(out, static_cast<uint32_t>(bytes));
  const bool full = r.kind == ReportKind::kFull;
  out[full ? kFullState : kState] = static_cast<uint8_t>(static_cast<int>(r.mode) << 4 | static_cast<int>(r.state));
  PutU16(out + (full ? kFullQueue : kQueue), static_cast<uint16_t>(r.queued));
  PutJointVector(out + (full ? kFullQ : kQ), r.q);
  PutJointVector(out + (full ? kFullTau : kTau), r.tau);
  if (full) {
    PutU32(out + kFullTime, static_cast<uint32_t>(time_us >> 32));
    PutU32(out + kFullTime + 4, static_cast<uint32_t>(time_us));
    PutJointVector(out + kFullTarget, q_target);
    PutJointVector(out + kFullDq, r.dq);
  }
  if (r.kind == ReportKind::kNormal || r.kind == ReportKind::kRich) {
    out[kBrakes] = r.brakes;
    out[kEnabled] = r.enabled;
    out[kError] = static_cast<uint8_t>(r.error);
    out[kWarning] = static_cast<uint8_t>(r.warning);
    out[kCollision] = 3;
    out[kTeach] = 3;
    PutFloat(out + 141, -1);  // gravity along -z
  }
  if (r.kind == ReportKind::kRich) {
    out[145] = 9;  // Lite 6
    out[146] = 6;  // axes
    std::memcpy(out + 151, "v2.5.0", 6);
  }
  return static_cast<int>(bytes);
}

}  // namespace intabs::lite6
