#include "intabs/lite6/wire.h"

#include <bit>
#include <cmath>
#include <cstring>

namespace intabs::lite6 {
namespace {

// What the vendor's client sends along with every joint target; the controller ignores it in servo mode.
constexpr double kDegree = 0.017453292519943295;
constexpr double kUnusedSpeed = 20 * kDegree, kUnusedAcceleration = 500 * kDegree;

class ParameterWriter {
 public:
  explicit ParameterWriter(Register reg) noexcept { request_.reg = reg; }
  ParameterWriter& U8(uint8_t v) noexcept {
    request_.parameters[request_.size++] = v;
    return *this;
  }
  ParameterWriter& U16(uint16_t v) noexcept {
    PutU16(&request_.parameters[request_.size], v);
    request_.size += 2;
    return *this;
  }
  ParameterWriter& Float(double v) noexcept {
    PutFloat(&request_.parameters[request_.size], v);
    request_.size += 4;
    return *this;
  }
  ParameterWriter& Joints(const JointVector& v) noexcept {
    PutJointVector(&request_.parameters[request_.size], v);
    request_.size += 4 * kVendorJoints;
    return *this;
  }
  const Request& Done() const noexcept { return request_; }

 private:
  Request request_;
};

}  // namespace

void PutU16(uint8_t* out, uint16_t v) noexcept {
  out[0] = static_cast<uint8_t>(v >> 8);
  out[1] = static_cast<uint8_t>(v);
}
void PutU32(uint8_t* out, uint32_t v) noexcept {
  PutU16(out, static_cast<uint16_t>(v >> 16));
  PutU16(out + 2, static_cast<uint16_t>(v));
}
void PutFloat(uint8_t* out, double v) noexcept {
  const auto bits = std::bit_cast<uint32_t>(static_cast<float>(v));
  for (int i = 0; i < 4; ++i) out[i] = static_cast<uint8_t>(bits >> (8 * i));
}
uint16_t GetU16(const uint8_t* in) noexcept { return static_cast<uint16_t>(in[0] << 8 | in[1]); }
uint32_t GetU32(const uint8_t* in) noexcept { return uint32_t{GetU16(in)} << 16 | GetU16(in + 2); }
double GetFloat(const uint8_t* in) noexcept {
  uint32_t bits = 0;
  for (int i = 0; i < 4; ++i) bits |= uint32_t{in[i]} << (8 * i);
  return std::bit_cast<float>(bits);
}

bool GetJointVector(const uint8_t* in, double limit, JointVector& out) noexcept {
  JointVector v;
  for (int i = 0; i < kNumJoints; ++i) v[i] = GetFloat(in + 4 * i);
  if (!(v.cwiseAbs().array() <= limit).all()) return false;  // NaN too
  out = v;
  return true;
}
void PutJointVector(uint8_t* out, const JointVector& v) noexcept {
  for (int i = 0; i < kVendorJoints; ++i) PutFloat(out + 4 * i, i < kNumJoints ? v[i] : 0);
}

Request Request::MotionEnable(bool on) noexcept {
  return ParameterWriter(Register::kMotionEnable).U8(8).U8(on ? 1 : 0).Done();
}
Request Request::SetMode(VendorMode mode) noexcept {
  return ParameterWriter(Register::kSetMode).U8(static_cast<uint8_t>(mode)).U8(0).Done();
}
Request Request::SetState(VendorState state) noexcept {
  return ParameterWriter(Register::kSetState).U8(static_cast<uint8_t>(state)).Done();
}
Request Request::ServoJ(const JointVector& q) noexcept {
  return ParameterWriter(Register::kServoJ)
      .Joints(q)
      .Float(kUnusedSpeed)
      .Float(kUnusedAcceleration)
      .Float(0)
      .Done();
}
Request Request::VelocityJ(const JointVector& dq, bool sync, double duration) noexcept {
  return ParameterWriter(Register::kVelocityJ).Joints(dq).U8(sync ? 1 : 0).Float(duration).Done();
}
Request Request::MoveJoint(const JointVector& q, double speed, double acceleration) noexcept {
  return ParameterWriter(Register::kMoveJoint).Joints(q).Float(speed).Float(acceleration).Float(0).Done();
}
Request Request::GetJoints(int what) noexcept {
  return ParameterWriter(Register::kGetJoints).U8(static_cast<uint8_t>(what)).Done();
}
Request Request::SetToolOutput(int output, bool on) noexcept {
  const int mask = 1 << output;
  return ParameterWriter(Register::kWriteTool)
      .U8(kToolHost)
      .U16(kToolOutputs)
      .Float(mask << 8 | (on ? mask : 0))
      .U8(0)
      .Done();
}
Request Request::ReadTool(uint16_t address) noexcept {
  return ParameterWriter(Register::kReadTool).U8(kToolHost).U16(address).Done();
}
Request Request::SetLoad(double mass, const std::array<double, 3>& com_mm) noexcept {
  return ParameterWriter(Register::kSetLoad).Float(mass).Float(com_mm[0]).Float(com_mm[1]).Float(com_mm[2]).Done();
}
Request Request::SetLinearSpeedFactor(double factor) noexcept {
  return ParameterWriter(Register::kSetCommonParameter).U8(1).Float(factor).Done();
}

void EncodeRequest(const Request& request, uint16_t tid, uint16_t protocol, Frame& out) noexcept {
  PutU16(&out.bytes[0], tid);
  PutU16(&out.bytes[2], protocol);
  PutU16(&out.bytes[4], static_cast<uint16_t>(1 + request.size));
  out.bytes[6] = static_cast<uint8_t>(request.reg);
  std::memcpy(&out.bytes[kHeaderBytes], request.parameters.data(), static_cast<size_t>(request.size));
  out.size = kHeaderBytes + request.size;
}

Parsed ParseFrame(const uint8_t* data, size_t size, FrameView& frame, size_t& used) noexcept {
  if (size < 6) return Parsed::kMore;
  const uint16_t protocol = GetU16(data + 2), length = GetU16(data + 4);
  if (protocol != kPlainProtocol && protocol != kHeartbeatProtocol) return Parsed::kBroken;
  if (length < 1 || length > 1 + kMaxBodyBytes) return Parsed::kBroken;
  if (size < size_t{6} + length) return Parsed::kMore;
  frame.tid = GetU16(data);
  frame.protocol = protocol;
  frame.reg = static_cast<Register>(data[6]);
  frame.body = data + kHeaderBytes;
  frame.size = length - 1;
  used = size_t{6} + length;
  return Parsed::kFrame;
}

ReplyFit ReadReply(const FrameView& frame, Register reg, uint16_t tid, uint16_t protocol, Reply& reply) noexcept {
  if (frame.reg == Register::kFeedback || frame.tid != tid) return ReplyFit::kIgnored;
  if (frame.protocol != protocol || frame.reg != reg || frame.size < 1) return ReplyFit::kBroken;
  reply.status = frame.body[0];
  reply.payload = frame.body + 1;
  reply.size = frame.size - 1;
  return ReplyFit::kOurs;
}

bool ReadJoints(const Reply& reply, int what, JointVector& q, JointVector& dq, JointVector& tau) noexcept {
  constexpr int kBytes = 4 * kVendorJoints;
  if (what < 1 || what > 3 || reply.size < what * kBytes) return false;
  JointVector position, speed = dq, torque = tau;
  if (!GetJointVector(reply.payload, kSanePosition, position)) return false;
  if (what > 1 && !GetJointVector(reply.payload + kBytes, kSaneSpeed, speed)) return false;
  if (what > 2 && !GetJointVector(reply.payload + 2 * kBytes, kSaneTorque, torque)) return false;
  q = position;
  dq = speed;
  tau = torque;
  return true;
}

}  // namespace intabs::lite6
