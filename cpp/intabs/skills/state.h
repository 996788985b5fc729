// What the policy sees: one tick's readings -> features. The one implementation: training calls it through the bindings,
// the control loop calls it in the tick.
#pragma once

#include <array>

#include "intabs/core/status.h"
#include "intabs/core/types.h"
#include "intabs/kinematics/arm_model.h"

namespace intabs {

// Everything the policy may know at a tick.
struct Observation {
  JointVector q = JointVector::Zero();  // measured [rad]
  bool gripper_closed = false;          // commanded
  std::array<TrackedObject, kMaxObjects> objects;
};

// Name of this layout; weights carry the one they were trained with.
inline constexpr char kStateLayout[] = "gripper-relative/2";

inline constexpr int kAgentDim = kNumJoints + 1;           // q, gripper (+1 closed, -1 open)
inline constexpr int kObjectDim = 13;                      // an object, see AssembleState
inline constexpr int kEnvironmentDim = kObjectDim * kMaxObjects;
inline constexpr int kStateDim = kAgentDim + kEnvironmentDim;
inline constexpr int kAgentActionDim = kNumJoints + 1;     // joint step [rad a tick], gripper (> 0: closed)
inline constexpr int kObjectMotionDim = 6;                 // an object's motion in one tick, see ObjectMotion
inline constexpr int kEnvironmentActionDim = kObjectMotionDim * kMaxObjects;

inline constexpr double kNear = 0.01;  // [m]

using StateVector = Eigen::Matrix<float, kStateDim, 1>;

// Features s = [s^r, s^e], not normalised. s^r = [q, +-1]; s^e = for each slot [p_GO (m, in the gripper's tip frame G),
// R_GO e_x, R_GO e_y, valid, p_GO / (kNear + |p_GO|) by axis]. Poses relative to the gripper generalise over the place
// of the objects; the compressed copy of the position tells millimetres apart where they matter, near the gripper. An
// object that was never seen is all zeros; one that is lost (valid false, id known) keeps the pose given and valid 0.
// Real-time safe. kInvalidInput if anything is not finite.
Status AssembleState(const ArmModel& arm, const Observation& observation, StateVector& s) noexcept;

// a^e of one object between two ticks: [R_WG^T (p_WO' - p_WO) (m), R_WG^T log(R_WO' R_WO^T) (rad)], G at the first tick.
Eigen::Matrix<float, kObjectMotionDim, 1> ObjectMotion(const Pose& X_WG, const Pose& X_WO, const Pose& X_WO_next) noexcept;

}  // namespace intabs
