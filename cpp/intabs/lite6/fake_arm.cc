#include "intabs/lite6/fake_arm.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <numbers>

namespace intabs::lite6 {
namespace {

constexpr double kDt = kDriverPeriodUs * 1e-6;
constexpr double kJointSpeed = std::numbers::pi;  // [rad/s]
constexpr double kTipSpeed = 0.5;                 // [m/s], times the factor
constexpr double kGuideSpeed = 0.5;               // [rad/s]
constexpr double kAcceleration = 20;              // [rad/s^2]
constexpr double kLimitTolerance = 0.1 * std::numbers::pi / 180;
constexpr size_t kQueueLength = 256;
constexpr int kPumpStopTicks = 50;  // both outputs low for so long are a stop, not the middle of a change
constexpr char kVersion[] = "6,9,LI1003,DL1000,v2.5.0";
constexpr char kSerialNumber[] = "LI1003";
constexpr int kTextBytes = 40;
constexpr double kEncoderShare = 0.3;  // measured speeds are smoothed, here over some 10 ms
constexpr uint8_t kAllJoints = 0x3f;

// The next position on the way to `target`, at most `speed` [rad/s].
JointVector Towards(const JointVector& from, const JointVector& target, double speed) {
  const JointVector way = target - from;
  const double longest = way.cwiseAbs().maxCoeff();
  return longest <= speed * kDt ? target : JointVector(from + way * (speed * kDt / longest));
}

}  // namespace

FakeArm::FakeArm(const JointVector& q) : q_target_(q), q_ref_(q), q_(q), guide_(q) { ForgetTargets(); }

void FakeArm::Handle(const FrameView& request, Frame& reply) {
  ++requests_;
  int size = 0;
  const bool could_move = enabled_ && Moves();  // what changes that says so in the next reply
  uint8_t* const body = &reply.bytes[kHeaderBytes];
  uint8_t status = Do(request, body + 1, size);
  if (error_ != 0) status |= kStatusError;
  if (warning_ != 0) status |= kStatusWarning;
  if (!could_move) status |= kStatusCannotMove;
  body[0] = status;
  PutU16(&reply.bytes[0], request.tid);
  PutU16(&reply.bytes[2], request.protocol);
  PutU16(&reply.bytes[4], static_cast<uint16_t>(2 + size));
  reply.bytes[6] = static_cast<uint8_t>(request.reg);
  reply.size = kHeaderBytes + 1 + size;
}

uint8_t FakeArm::Do(const FrameView& request, uint8_t* payload, int& size) {
  const uint8_t* const p = request.body;
  const auto has = [&request](int bytes) { return request.size >= bytes; };
  const auto text = [&](const char* s) {
    std::memset(payload, 0, kTextBytes);
    std::memcpy(payload, s, std::strlen(s));
    size = kTextBytes;
  };
  switch (request.reg) {
    case Register::kGetVersion:
      text(kVersion);
      return 0;
    case Register::kGetRobotSn:
      text(kSerialNumber);
      return 0;
    case Register::kMotionEnable:
      if (!has(2) || estop_pressed_) return kStatusInvalid;
      enabled_ = p[1] != 0;
      if (!enabled_) Stop(VendorState::kStopped);
      return 0;
    case Register::kSetState:
      return has(1) ? SetState(p[0]) : kStatusInvalid;
    case Register::kGetState:
      payload[0] = static_cast<uint8_t>(Report(ReportKind::kReal).state);
      size = 1;
      return 0;
    case Register::kGetCommandCount:
      PutU16(payload, static_cast<uint16_t>(moves_.size()));
      size = 2;
      return 0;
    case Register::kGetError:
      payload[0] = static_cast<uint8_t>(error_);
      payload[1] = static_cast<uint8_t>(warning_);
      size = 2;
      return 0;
    case Register::kCleanError:
      error_ = estop_pressed_ ? 2 : 0;
      return 0;
    case Register::kCleanWarning:
      warning_ = 0;
      return 0;
    case Register::kSetMode:
      if (!has(1) || p[0] > 7) return kStatusInvalid;
      mode_ = static_cast<VendorMode>(p[0]);
      Stop(VendorState::kModeChanged);
      return 0;
    case Register::kServoJ:
      return has(4 * kVendorJoints) ? ServoJ(p) : kStatusInvalid;
    case Register::kVelocityJ: {
      const uint8_t status = Motion(VendorMode::kJointVelocity, VendorMode::kJointVelocity);
      if (status != 0) return status;
      if (!has(4 * kVendorJoints + 1) || !GetJointVector(p, kJointSpeed, velocity_)) return kStatusInvalid;
      const double duration = has(4 * kVendorJoints + 5) ? GetFloat(p + 4 * kVendorJoints + 1) : 0;
      velocity_until_ = duration > 0 ? tick_ + std::lround(std::min(duration, 1e6) / kDt) : INT64_MAX;
      return 0;
    }
    case Register::kMoveJoint:
    case Register::kMoveHome: {
      const uint8_t status = Motion(VendorMode::kPosition, VendorMode::kOnlinePosition);
      if (status != 0) return status;
      Move move{JointVector::Zero(), 0.3};
      if (request.reg == Register::kMoveJoint) {
        if (!has(4 * kVendorJoints + 8) || !GetJointVector(p, kSanePosition, move.q)) return kStatusInvalid;
        move.speed = GetFloat(p + 4 * kVendorJoints);
        if (!(move.speed > 0)) return kStatusInvalid;
        move.speed = std::min(move.speed, kJointSpeed);
      }
      if (mode_ == VendorMode::kOnlinePosition) moves_.clear();
      if (moves_.size() >= kQueueLength) {
        warning_ = 11;
        return 0;
      }
      moves_.push_back(move);
      PutU16(payload, static_cast<uint16_t>(moves_.size()));
      size = 2;
      return 0;
    }
    case Register::kGetTcpPose:
    case Register::kGetTcpPoseAxisAngle: {
      const Pose X_BG = model_.Tip(q_);
      const Eigen::Vector3d rpy = X_BG.q.toRotationMatrix().eulerAngles(2, 1, 0).reverse();
      const Eigen::Vector3d turn = request.reg == Register::kGetTcpPose ? rpy : LogSO3(X_BG.q);
      for (int i = 0; i < 3; ++i) {
        PutFloat(payload + 4 * i, 1000 * X_BG.p[i]);
        PutFloat(payload + 12 + 4 * i, turn[i]);
      }
      size = 24;
      return 0;
    }
    case Register::kGetJoints: {
      const int what = has(1) ? p[0] : 1;
      if (what < 1 || what > 3) return kStatusInvalid;
      PutJointVector(payload, q_);
      if (what > 1) PutJointVector(payload + 28, dq_);
      if (what > 2) PutJointVector(payload + 56, tau_);
      size = 28 * what;
      return 0;
    }
    case Register::kGetJointTorque:
      PutJointVector(payload, tau_);
      size = 28;
      return 0;
    case Register::kSetCollisionSensitivity:
      if (!has(1) || p[0] > 5) return kStatusInvalid;
      collision_ = p[0];
      Stop(VendorState::kModeChanged);  // the vendor calls it a system reset
      return 0;
    case Register::kSetTeachSensitivity:
      if (!has(1) || p[0] < 1 || p[0] > 5) return kStatusInvalid;
      teach_ = p[0];
      Stop(VendorState::kModeChanged);
      return 0;
    case Register::kSetLoad:
      if (!has(16)) return kStatusInvalid;
      Stop(VendorState::kModeChanged);
      return 0;
    case Register::kSetTcpOffset:
      if (!has(24)) return kStatusInvalid;
      Stop(VendorState::kModeChanged);
      return 0;
    case Register::kSetBrake:
    case Register::kSaveConfiguration:
    case Register::kSetFeedbackType:
      return 0;
    case Register::kCheckFeedback:
      payload[0] = 0;
      size = 1;
      return 0;
    case Register::kWriteTool:
      return WriteTool(request);
    case Register::kReadTool:
      if (!has(3)) return kStatusInvalid;
      PutU32(payload, GetU16(p + 1) == kToolOutputsRead ? outputs_ : 0);
      size = 4;
      return 0;
    case Register::kSetCommonParameter:
      if (!has(5) || p[0] != 1 || !(GetFloat(p + 1) > 0)) return kStatusInvalid;
      linear_factor_ = GetFloat(p + 1);
      return 0;
    default:
      warning_ = 13;
      return kStatusInvalid;
  }
}

uint8_t FakeArm::Motion(VendorMode wanted, VendorMode other) const {
  if (error_ != 0) return kStatusError;
  if (mode_ != wanted && mode_ != other) return kStatusInvalid;
  return enabled_ && Moves() ? 0 : kStatusCannotMove;
}

uint8_t FakeArm::ServoJ(const uint8_t* p) {
  const uint8_t status = Motion(VendorMode::kServo, VendorMode::kServo);
  JointVector q;
  if (status != 0 || !GetJointVector(p, kSanePosition, q)) {
    ++rejected_;
    return status != 0 ? status : kStatusInvalid;
  }
  if ((q.array() < model_.q_min().array() - kLimitTolerance).any() ||
      (q.array() > model_.q_max().array() + kLimitTolerance).any()) {
    ++rejected_;
    RaiseError(23);
    return kStatusError;
  }
  ++servo_requests_;
  q_target_ = q;
  new_target_ = true;
  return 0;
}

uint8_t FakeArm::SetState(int state) {
  if (state == 0) {
    if (error_ != 0 || !enabled_) return kStatusCannotMove;
    state_ = VendorState::kSleeping;
    q_target_ = q_ref_ = q_;  // motors take over where the arm is
    dq_ref_.setZero();
    guide_ = q_;
    ForgetTargets();
    return 0;
  }
  if (state != 3 && state != 4 && state != 6) return kStatusInvalid;
  Stop(static_cast<VendorState>(state));
  return 0;
}

uint8_t FakeArm::WriteTool(const FrameView& request) {
  if (request.size < 7 || GetU16(request.body + 1) != kToolOutputs) return kStatusInvalid;
  const double value = GetFloat(request.body + 3);
  if (!(value >= 0 && value < 65536)) return kStatusInvalid;
  const int word = static_cast<int>(value);
  ++gripper_writes_;
  outputs_ = static_cast<uint8_t>((outputs_ & ~(word >> 8)) | (word & (word >> 8)));
  switch (outputs_ & 3) {
    case 1:
      gripper_ = Gripper::kOpen;
      break;
    case 2:
      // "Once stop, close will be invalid, you must open first."
      if (gripper_ == Gripper::kStopped) {
        ++close_ignored_;
      } else {
        gripper_ = Gripper::kClosed;
      }
      break;
    default:
      break;
  }
  return 0;
}

void FakeArm::TickGripper() {
  both_low_ticks_ = (outputs_ & 3) == 0 ? both_low_ticks_ + 1 : 0;
  if (both_low_ticks_ >= kPumpStopTicks) gripper_ = Gripper::kStopped;
}

void FakeArm::Stop(VendorState state) {
  state_ = state;
  moves_.clear();
  velocity_.setZero();
}

void FakeArm::RaiseError(int code) {
  error_ = code;
  if (code != 0) Stop(VendorState::kStopped);
}

void FakeArm::SetEstopButton(bool pressed) {
  estop_pressed_ = pressed;
  if (!pressed) return;
  RaiseError(2);
  enabled_ = false;
}

void FakeArm::LoseHeartbeat() {
  if (Moves()) Stop(VendorState::kStopped);
}

void FakeArm::Measure(const JointVector& q, const JointVector& dq, const JointVector& tau) {
  measured_ = true;
  q_ = q;
  dq_ = dq;
  tau_ = tau;
}

void FakeArm::ForgetTargets() {
  past_.fill(q_target_);
  past_tip_.fill(model_.Tip(q_target_).p);
}

void FakeArm::CheckSpeeds() {
  const Eigen::Vector3d tip = model_.Tip(q_target_).p;
  JointVector& oldest = past_[static_cast<size_t>(tick_ % kWindow)];
  Eigen::Vector3d& oldest_tip = past_tip_[static_cast<size_t>(tick_ % kWindow)];
  const double speed = (q_target_ - oldest).cwiseAbs().maxCoeff() / (kWindow * kDt);
  const double tip_speed = (tip - oldest_tip).norm() / (kWindow * kDt);
  const JointVector& last = past_[static_cast<size_t>((tick_ + kWindow - 1) % kWindow)];
  max_step_ = std::max(max_step_, (q_target_ - last).cwiseAbs().maxCoeff());
  max_speed_ = std::max(max_speed_, speed);
  max_tip_speed_ = std::max(max_tip_speed_, tip_speed);
  oldest = q_target_;
  oldest_tip = tip;
  if (speed > kJointSpeed) RaiseError(24);
  if (tip_speed > linear_factor_ * kTipSpeed) RaiseError(60);
}

void FakeArm::Tick() {
  const JointVector before = q_ref_;
  if (!enabled_ && state_ != VendorState::kModeChanged) state_ = VendorState::kStopped;
  if (!Moves()) {  // brakes
    const double dv = kAcceleration * kDt;
    dq_ref_ = dq_ref_.cwiseSign().cwiseProduct((dq_ref_.cwiseAbs().array() - dv).max(0).matrix());
    q_ref_ += dq_ref_ * kDt;
    q_target_ = q_ref_;
  } else {
    switch (mode_) {
      case VendorMode::kServo:
        ++servo_ticks_;
        late_ticks_ += !new_target_;
        new_target_ = false;
        CheckSpeeds();
        if (Moves()) q_ref_ = Towards(q_ref_, q_target_, kJointSpeed);
        break;
      case VendorMode::kTeach:
        q_ref_ = Towards(q_ref_, guide_, kGuideSpeed);
        break;
      case VendorMode::kJointVelocity:
        if (tick_ >= velocity_until_) velocity_.setZero();
        q_ref_ = (q_ref_ + velocity_ * kDt).cwiseMax(model_.q_min()).cwiseMin(model_.q_max());
        break;
      default:
        if (!moves_.empty()) {
          q_ref_ = Towards(q_ref_, moves_.front().q, moves_.front().speed);
          if (q_ref_ == moves_.front().q) moves_.pop_front();
        }
    }
    dq_ref_ = (q_ref_ - before) / kDt;
    if (mode_ != VendorMode::kServo) q_target_ = q_ref_;
  }
  if (!measured_) {
    q_ = q_ref_;
    dq_ += kEncoderShare * (dq_ref_ - dq_);
  }
  TickGripper();
  ++tick_;
}

ArmReport FakeArm::Report(ReportKind kind) const {
  ArmReport r;
  r.kind = kind;
  r.mode = mode_;
  r.state = state_;
  if (Moves()) r.state = dq_ref_.cwiseAbs().maxCoeff() > 1e-4 ? VendorState::kMoving : VendorState::kSleeping;
  r.queued = static_cast<int>(moves_.size());
  r.q = q_;
  r.dq = dq_;
  r.tau = tau_;
  r.error = error_;
  r.warning = warning_;
  r.enabled = r.brakes = enabled_ ? kAllJoints : 0;
  return r;
}

std::string FakeArm::Json() const {
  const auto joints = [](const JointVector& v) {
    std::string s = "[";
    for (int i = 0; i < kNumJoints; ++i) {
      char number[32];
      std::snprintf(number, sizeof(number), "%s%.9g", i > 0 ? ", " : "", v[i]);
      s += number;
    }
    return s + "]";
  };
  const char* gripper = gripper_ == Gripper::kOpen ? "open" : gripper_ == Gripper::kClosed ? "closed" : "stopped";
  char text[1024];
  std::snprintf(text, sizeof(text),
                "\"mode\": %d, \"state\": %d, \"error\": %d, \"warning\": %d, \"enabled\": %s, \"gripper\": \"%s\", "
                "\"gripper_writes\": %ld, \"close_ignored\": %ld, \"requests\": %ld, \"servo_requests\": %ld, "
                "\"servo_rejected\": %ld, \"servo_ticks\": %ld, \"servo_ticks_without_target\": %ld, "
                "\"max_joint_speed\": %.6f, \"max_tip_speed\": %.6f, \"max_step_rad\": %.6f",
                static_cast<int>(mode_), static_cast<int>(Report(ReportKind::kReal).state), error_, warning_,
                enabled_ ? "true" : "false", gripper, static_cast<long>(gripper_writes_),
                static_cast<long>(close_ignored_), static_cast<long>(requests_), static_cast<long>(servo_requests_),
                static_cast<long>(rejected_), static_cast<long>(servo_ticks_), static_cast<long>(late_ticks_), max_speed_,
                max_tip_speed_, max_step_);
  return "{" + std::string(text) + ", \"q\": " + joints(q_) + ", \"q_target\": " + joints(q_target_) + "}";
}

}  // namespace intabs::lite6
