// A Lite 6 as its controller shows it over the wire, without sockets: registers in, replies and reports out. For tests
// and for users without an arm. It is as strict as the real one is known to be, and stricter where that is not known.
#pragma once

#include <array>
#include <cstdint>
#include <deque>
#include <string>

#include "intabs/control/arm_controller.h"
#include "intabs/core/types.h"
#include "intabs/lite6/report.h"
#include "intabs/lite6/wire.h"

namespace intabs::lite6 {

// One thread. Time is its own ticks of 4 ms.
class FakeArm {
 public:
  explicit FakeArm(const JointVector& q);

  // Answers one request.
  void Handle(const FrameView& request, Frame& reply);

  // 4 ms. In servo mode the newest target is taken as it is, as the real one does; C24 and C60 watch how fast the
  // targets went over the last 40 ms. Elsewhere joints move evenly; a stop brakes at 20 rad/s^2.
  void Tick();

  ArmReport Report(ReportKind kind) const;
  const JointVector& q_target() const { return q_target_; }

  // What the motors are told [rad], [rad/s], and the gripper.
  const JointVector& q_ref() const { return q_ref_; }
  const JointVector& dq_ref() const { return dq_ref_; }
  bool gripper_closed() const { return gripper_ == Gripper::kClosed; }
  // What the encoders read; without a body behind it that is q_ref.
  void Measure(const JointVector& q, const JointVector& dq, const JointVector& tau);

  // From outside.
  void RaiseError(int code);
  void RaiseWarning(int code) { warning_ = code; }
  void SetEstopButton(bool pressed);
  // A hand that leads the arm there in manual mode.
  void Guide(const JointVector& q) { guide_ = q; }
  // Nobody speaks any more: stops if it moves.
  void LoseHeartbeat();

  // Figures: one line of JSON.
  std::string Json() const;

 private:
  enum class Gripper { kStopped, kOpen, kClosed };
  struct Move {
    JointVector q;
    double speed;
  };
  static constexpr int kWindow = 10;  // ticks

  uint8_t Do(const FrameView& request, uint8_t* payload, int& size);
  uint8_t Motion(VendorMode wanted, VendorMode other) const;  // status bits that forbid a motion
  uint8_t ServoJ(const uint8_t* p);
  uint8_t SetState(int state);
  uint8_t WriteTool(const FrameView& request);
  bool Moves() const { return state_ == VendorState::kMoving || state_ == VendorState::kSleeping; }
  void Stop(VendorState state);
  void CheckSpeeds();
  void ForgetTargets();
  void TickGripper();

  const ArmModel model_ = ArmModel::Lite6();
  VendorMode mode_ = VendorMode::kPosition;
  VendorState state_ = VendorState::kStopped;
  bool enabled_ = false, estop_pressed_ = false;
  int error_ = 0, warning_ = 0;
  double linear_factor_ = 1.2;
  uint8_t collision_ = 3, teach_ = 3;

  JointVector q_target_, q_ref_, dq_ref_ = JointVector::Zero();
  JointVector q_, dq_ = JointVector::Zero(), tau_ = JointVector::Zero();
  bool measured_ = false;
  JointVector guide_;
  JointVector velocity_ = JointVector::Zero();  // velocity mode
  int64_t velocity_until_ = 0;                  // tick
  std::deque<Move> moves_;

  uint8_t outputs_ = 0;  // of the tool
  Gripper gripper_ = Gripper::kStopped;
  int both_low_ticks_ = 0;

  std::array<JointVector, kWindow> past_;  // targets of the last ticks, oldest at tick_ % kWindow
  std::array<Eigen::Vector3d, kWindow> past_tip_;
  int64_t tick_ = 0;

  int64_t requests_ = 0, servo_requests_ = 0, rejected_ = 0, gripper_writes_ = 0, close_ignored_ = 0;
  int64_t servo_ticks_ = 0, late_ticks_ = 0;  // in servo mode; those without a new target
  bool new_target_ = false;
  double max_speed_ = 0, max_tip_speed_ = 0, max_step_ = 0;
};

}  // namespace intabs::lite6
