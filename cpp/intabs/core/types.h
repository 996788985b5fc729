// What the processes say to each other, as plain fixed-size structs. `bus` turns them into LCM messages and back;
// in-process runs pass them by reference. SI units and radians. All times `*_us` are microseconds of one clock:
// the host's monotonic clock, or simulation time in lockstep.
#pragma once

#include <array>
#include <cstdint>

#include "intabs/core/pose.h"

namespace intabs {

inline constexpr int kNumJoints = 6;
inline constexpr int kMaxObjects = 4;
inline constexpr int kMaxTags = 10;     // a TAG_DETECTIONS message
inline constexpr int kMaxCameras = 4;   // a PERCEPTION_STATUS message
inline constexpr int kLatentDim = 16;  // z = [z_agent, z_environment]; how many of each, the encoders say

inline constexpr int64_t kDriverPeriodUs = 4000;   // 250 Hz
inline constexpr int64_t kPolicyPeriodUs = 40000;  // 25 Hz; a policy's manifest must agree

using JointVector = Eigen::Matrix<double, kNumJoints, 1>;
using LatentVector = Eigen::Matrix<float, kLatentDim, 1>;

enum class ArmMode : int8_t {
  kHold = 0,   // slow down and hold the pose reached
  kServo = 1,  // follow q_target
};

// Where the safety state machine stands (control/arm_controller.h).
enum class ArmState : int8_t {
  kIdle = 0,      // no session yet; holds the pose it found
  kTracking = 1,  // follows the session's commands
  kSlowing = 2,   // decelerating to a stop after a stale command or a hold command
  kHolding = 3,   // stopped, holds the pose reached; a new session may take over
  kFault = 4,     // held too long without a command: needs RESET
  kStopped = 5,   // ESTOP: needs RESET
  kAligning = 6,  // goes slowly to a session's first target, if that is far away; then kTracking
};

enum class Fault : int8_t {
  kNone = 0,
  kStaleCommand = 1,  // the running session went silent
  kEstop = 2,
  kStaleStatus = 3,  // the arm's readings stopped coming
  kLink = 4,         // the connection to the arm is lost
  kVendor = 5,       // the arm reports an error: vendor_error
  kOverrun = 6,      // the driver's loop stood still in mid-motion
};

enum class Refusal : int8_t {
  kAccepted = 0,
  kForeignSession = 1,  // another session is running, or a RESET is needed
  kUnknownMode = 2,
  kNotFinite = 3,
  kOutOfRange = 4,      // outside the joint limits, or a non-positive speed or lifetime
  kOldSequence = 5,     // repeated or reordered
};
inline constexpr int kNumRefusals = 6;

struct ArmCommand {
  int64_t utime = 0;
  int64_t seq = 0;
  int64_t session = 0;      // random, > 0
  int64_t status_seq = 0;   // seq of the ArmStatus this answers
  ArmMode mode = ArmMode::kHold;
  JointVector q_target = JointVector::Zero();                // [rad]
  JointVector dq_max = JointVector::Constant(2.14);          // [rad/s]
  bool gripper_closed = false;
  int64_t lifetime_us = 200000;  // counted from receipt
};

struct ArmStatus {
  int64_t utime = 0;
  int64_t seq = 0;
  int64_t source = 0;    // random id of the driver or plant that speaks: two on one bus are told apart by it
  int64_t session = 0;   // session being obeyed, 0: none
  JointVector q = JointVector::Zero();            // measured [rad]
  JointVector dq = JointVector::Zero();           // measured [rad/s]
  JointVector q_commanded = JointVector::Zero();  // output of the command filter [rad]
  JointVector tau = JointVector::Zero();          // measured or estimated joint torque [Nm]
  bool gripper_closed = false;    // commanded
  double gripper_opening = 0;     // estimated, both fingers together [m]
  ArmMode mode = ArmMode::kHold;
  ArmState state = ArmState::kIdle;
  Fault fault = Fault::kNone;
  int32_t vendor_error = 0;
  int64_t last_command_seq = 0;
  int64_t last_frame_seq = 0;     // newest camera frame of a simulated plant, 0: none
  std::array<int32_t, kNumRefusals> refused{};  // by Refusal; [0] counts undecodable datagrams
  int32_t overruns = 0;
  float tick_us = 0;
};

// One tracked object. An unused slot has id -1, null pose, invalid.
struct TrackedObject {
  int32_t id = -1;
  Pose X_WO;
  // Upper triangle, row by row, of the covariance of (rotation vector [rad], position [m]), both in W, additive on the left.
  std::array<float, 21> covariance{};
  uint8_t cameras = 0;  // bit i: camera i contributed
  bool valid = false;
  float age = 0;        // s since the last frame that saw it
};

struct ObjectPoses {
  int64_t utime = 0;           // when it was computed
  int64_t exposure_utime = 0;  // of the frame
  int64_t seq = 0;
  int64_t frame_seq = 0;
  std::array<TrackedObject, kMaxObjects> objects;
};

struct TagDetection {
  int32_t id = -1;
  std::array<Eigen::Vector2f, 4> corners;  // px, OpenCV's pixel-centre convention, AprilTag's order
  std::array<Pose, 2> X_CT;                // both hypotheses of the planar ambiguity, better one first
  std::array<float, 2> reprojection_px{};  // RMS
  float ambiguity = 0;                     // reprojection_px[0] / reprojection_px[1]
  float decision_margin = 0;
};

// One camera's detections of one frame.
struct TagDetections {
  int64_t utime = 0;
  int64_t exposure_utime = 0;
  int64_t seq = 0;
  int64_t frame_seq = 0;
  int n = 0;
  std::array<TagDetection, kMaxTags> tags;
};

// Whom an object touches: bits of PlantTruth::touches. Bit i < kMaxObjects: the object in slot i.
inline constexpr uint8_t kTouchesLeftFinger = 1 << 4;
inline constexpr uint8_t kTouchesRightFinger = 1 << 5;
inline constexpr uint8_t kTouchesArm = 1 << 6;    // any other part of the arm or gripper
inline constexpr uint8_t kTouchesScene = 1 << 7;  // table, cabinet, box, rack: what never moves; not beads

// What the plant knows. For scoring, labels and viewers; feeds control only under `--perception truth`.
struct PlantTruth {
  int64_t utime = 0;
  int64_t seq = 0;
  int64_t frame_seq = 0;
  std::array<TrackedObject, kMaxObjects> objects;  // in the same slots as ObjectPoses
  uint32_t subgoals = 0;  // bit i: sub-goal i of the task is reached
  bool success = false;
  uint64_t state_hash = 0;
  std::array<uint8_t, kMaxObjects> touches{};   // by slot: kTouches...
  std::array<int16_t, kMaxObjects> beads_in{};  // by slot: beads inside this vessel; 0 where it is none
  int16_t beads = 0;                            // in the world
};

// Poses as control takes them under `--perception truth`.
inline ObjectPoses PosesFromTruth(const PlantTruth& truth) {
  ObjectPoses poses;
  poses.utime = truth.utime;
  poses.exposure_utime = truth.utime;
  poses.seq = truth.seq;
  poses.frame_seq = truth.frame_seq;
  poses.objects = truth.objects;
  return poses;
}

}  // namespace intabs
