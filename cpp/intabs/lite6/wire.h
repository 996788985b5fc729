// The control protocol of the Lite 6's controller (TCP 502): frames, registers, requests. Pure functions on fixed
// memory, noexcept. Sources: UFACTORY's private TCP protocol (ufactory_docs, p05..p20) and xarm-python-sdk 1.18.4,
// whose bytes the requests reproduce. Here, and in report.h, units are the vendor's: rad, mm, s.
//
//   request: u16be tid | u16be protocol | u16be length | u8 register | parameters      length counts from the register
//   reply:   the same header, register, u8 status | payload
// Integers are big-endian in headers and addresses, floats (32 bit) little-endian; a joint vector has 7 of them.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

#include "intabs/core/types.h"

namespace intabs::lite6 {

inline constexpr int kVendorJoints = 7;
inline constexpr int kHeaderBytes = 7;     // up to and with the register
inline constexpr int kMaxBodyBytes = 512;  // behind the register; the longest known is 171
inline constexpr uint16_t kPlainProtocol = 2;
inline constexpr uint16_t kHeartbeatProtocol = 3;  // what the vendor's client speaks after the first answer

enum class Register : uint8_t {
  kGetVersion = 1,
  kGetRobotSn = 2,
  kSystemControl = 10,
  kMotionEnable = 11,
  kSetState = 12,
  kGetState = 13,
  kGetCommandCount = 14,
  kGetError = 15,
  kCleanError = 16,
  kCleanWarning = 17,
  kSetBrake = 18,
  kSetMode = 19,
  kMoveJoint = 23,
  kMoveHome = 25,
  kServoJ = 29,
  kSetTcpOffset = 35,
  kSetLoad = 36,
  kSetCollisionSensitivity = 37,
  kSetTeachSensitivity = 38,
  kSaveConfiguration = 40,
  kGetTcpPose = 41,
  kGetJoints = 42,
  kGetJointTorque = 55,
  kGetTcpPoseAxisAngle = 91,
  kVelocityJ = 81,
  kWriteTool = 127,
  kReadTool = 128,
  kSetCommonParameter = 232,
  kCheckFeedback = 253,
  kSetFeedbackType = 254,
  kFeedback = 255,  // pushed by the controller when asked for by kSetFeedbackType: not a reply
};

// Control modes of the vendor. Changing one leaves the arm in kModeChanged until SetState(kReady).
enum class VendorMode : uint8_t {
  kPosition = 0,
  kServo = 1,
  kTeach = 2,
  kJointVelocity = 4,
  kCartesianVelocity = 5,
  kOnlinePosition = 6,
};

// Motion states as GET_STATE and the reports tell them; SET_STATE takes 0 (ready), 3, 4 and 6.
enum class VendorState : uint8_t {
  kReady = 0,
  kMoving = 1,
  kSleeping = 2,  // ready, not moving
  kPaused = 3,
  kStopped = 4,
  kModeChanged = 5,
  kDecelerated = 6,
};

// Bits of a reply's status.
inline constexpr uint8_t kStatusError = 0x40;      // the controller has an error: GET_ERROR tells which
inline constexpr uint8_t kStatusWarning = 0x20;
inline constexpr uint8_t kStatusCannotMove = 0x10;  // not enabled, or a state that does not move
inline constexpr uint8_t kStatusInvalid = 0x08;     // this request failed: wrong mode, bad parameter

// Tool outputs: value = mask << 8 | bits. The gripper's pump hangs on two of them.
inline constexpr uint16_t kToolOutputs = 0x0A15;      // written
inline constexpr uint16_t kToolOutputsRead = 0x0A18;  // read: bits 0 and 1
inline constexpr uint8_t kToolHost = 9;

// A request without its header. `joints` in rad.
struct Request {
  Register reg = Register::kGetVersion;
  int size = 0;
  std::array<uint8_t, 64> parameters{};

  static Request Bare(Register reg) noexcept { return {reg, 0, {}}; }
  static Request MotionEnable(bool on) noexcept;  // all joints
  static Request SetMode(VendorMode mode) noexcept;
  static Request SetState(VendorState state) noexcept;
  // Latest target wins, followed like a step: the caller sends a smooth stream, at most 250 a second.
  static Request ServoJ(const JointVector& q) noexcept;
  static Request VelocityJ(const JointVector& dq, bool sync, double duration) noexcept;  // 0 s: for ever
  static Request MoveJoint(const JointVector& q, double speed, double acceleration) noexcept;
  static Request GetJoints(int what) noexcept;  // 1: positions, 2: and speeds, 3: and torques; 7 floats each
  static Request SetToolOutput(int output, bool on) noexcept;  // output 0 or 1, at once
  static Request ReadTool(uint16_t address) noexcept;
  static Request SetLoad(double mass, const std::array<double, 3>& com_mm) noexcept;
  static Request SetLinearSpeedFactor(double factor) noexcept;  // of the 500 mm/s in servo mode
};

// A frame ready to be sent.
struct Frame {
  int size = 0;
  std::array<uint8_t, kHeaderBytes + kMaxBodyBytes> bytes;
};

void EncodeRequest(const Request& request, uint16_t tid, uint16_t protocol, Frame& out) noexcept;

// A frame found in a stream; `body` points into the stream: parameters of a request, status and payload of a reply.
struct FrameView {
  uint16_t tid = 0;
  uint16_t protocol = 0;
  Register reg = Register::kGetVersion;
  const uint8_t* body = nullptr;
  int size = 0;
};

enum class Parsed {
  kMore,    // not yet a whole frame
  kFrame,   // `frame` is filled, `used` bytes belong to it
  kBroken,  // no frame can begin like this: give the connection up
};

// Looks at the beginning of a stream; reads no byte outside [data, data + size).
[[nodiscard]] Parsed ParseFrame(const uint8_t* data, size_t size, FrameView& frame, size_t& used) noexcept;

// A reply, taken apart.
struct Reply {
  uint8_t status = 0;
  const uint8_t* payload = nullptr;
  int size = 0;

  bool error() const noexcept { return (status & kStatusError) != 0; }
};

enum class ReplyFit {
  kOurs,
  kIgnored,  // of an earlier request that was given up, or pushed by the controller: wait on
  kBroken,   // protocol or register are not those of the request: give the connection up
};

[[nodiscard]] ReplyFit ReadReply(const FrameView& frame, Register reg, uint16_t tid, uint16_t protocol,
                                 Reply& reply) noexcept;

// Joint values of a GetJoints(what) reply. False, leaving everything as it was, when the payload is too short or has a
// number that no arm has (not finite, beyond 2 turns, 100 rad/s, 1000 Nm).
[[nodiscard]] bool ReadJoints(const Reply& reply, int what, JointVector& q, JointVector& dq, JointVector& tau) noexcept;

// Bytes in and out, without bounds checks.
void PutU16(uint8_t* out, uint16_t v) noexcept;
void PutU32(uint8_t* out, uint32_t v) noexcept;
void PutFloat(uint8_t* out, double v) noexcept;  // 32 bit, little-endian
uint16_t GetU16(const uint8_t* in) noexcept;
uint32_t GetU32(const uint8_t* in) noexcept;
double GetFloat(const uint8_t* in) noexcept;

// 7 floats to 6 joints. False when one is not finite or its magnitude is over `limit`.
[[nodiscard]] bool GetJointVector(const uint8_t* in, double limit, JointVector& out) noexcept;
void PutJointVector(uint8_t* out, const JointVector& v) noexcept;  // the seventh is 0

inline constexpr double kSanePosition = 13;  // [rad]: two turns and a bit
inline constexpr double kSaneSpeed = 100;    // [rad/s]
inline constexpr double kSaneTorque = 1000;  // [Nm]

}  // namespace intabs::lite6
