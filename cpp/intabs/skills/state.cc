#include "intabs/skills/state.h"

namespace intabs {

Status AssembleState(const ArmModel& arm, const Observation& o, StateVector& s) noexcept {
  if (!o.q.allFinite()) return Status::kInvalidInput;
  s.setZero();
  s.head<kNumJoints>() = o.q.cast<float>();
  s[kNumJoints] = o.gripper_closed ? 1.f : -1.f;
  const Pose X_GW = arm.Tip(o.q).Inverse();
  for (int i = 0; i < kMaxObjects; ++i) {
    const TrackedObject& object = o.objects[i];
    if (object.id < 0) continue;
    if (!object.X_WO.IsFinite()) return Status::kInvalidInput;
    const Pose X_GO = X_GW * object.X_WO;
    auto f = s.segment<kObjectDim>(kAgentDim + i * kObjectDim);
    f.head<3>() = X_GO.p.cast<float>();
    f.segment<6>(3) = To6D(X_GO.q).cast<float>();
    f[9] = object.valid ? 1.f : 0.f;
    f.tail<3>() = (X_GO.p.array() / (kNear + X_GO.p.array().abs())).cast<float>();
  }
  return Status::kOk;
}

Eigen::Matrix<float, kObjectMotionDim, 1> ObjectMotion(const Pose& X_WG, const Pose& X_WO,
                                                       const Pose& X_WO_next) noexcept {
  Eigen::Matrix<double, kObjectMotionDim, 1> m;
  const Eigen::Quaterniond R_GW = X_WG.q.conjugate();
  m.head<3>() = R_GW * (X_WO_next.p - X_WO.p);
  m.tail<3>() = R_GW * LogSO3(X_WO_next.q * X_WO.q.conjugate());
  return m.cast<float>();
}

}  // namespace intabs
