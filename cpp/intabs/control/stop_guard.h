// Whether the arm could stop from a state without touching itself or the table, without leaving its
// workspace, and without a tip too fast.
#pragma once

#include <array>
#include <limits>

#include "intabs/control/arm_shape.h"
#include "intabs/control/axis.h"
#include "intabs/core/types.h"
#include "intabs/kinematics/arm_model.h"

namespace intabs {

// In the arm's base frame B. [m]
struct ArmSpace {
  double self_margin = 0.010;   // between capsules
  double table_z = 0;           // height of the table's top; -infinity: no table
  double table_margin = 0.002;  // above it
  Eigen::Vector3d tip_min{-0.60, -0.60, -0.15}, tip_max{0.60, 0.60, 0.90};  // the tip's box
  double tip_speed_guard = 0.6;                                             // [m/s], never exceeded
};

using AxisStates = std::array<AxisState, kNumJoints>;

// Real-time safe, fixed memory, deterministic. Single precision: good to 1e-5 m.
class StopGuard {
 public:
  StopGuard(const ArmModel& model, const ArmSpace& space,
            const std::array<AxisLimits, kNumJoints>& limits) noexcept;

  // At rest at q, from where the arm must be able to leave: what is too near there is allowed to stay as near
  // as it is, not nearer.
  void Reset(const JointVector& q) noexcept;

  // Whether each joint's fastest stop from `s` keeps everything clear. Looks at 16 instants from `s` to rest,
  // at most 13 ms apart; what the tip's speed can do in between is added to it.
  bool StopIsFree(const AxisStates& s) noexcept { return Free(s, 1); }
  // The same for a stop with (almost) unlimited jerk, all accelerations of `s` being 0.
  bool HaltIsFree(const AxisStates& s) noexcept { return Free(s, 1e4); }

  // The state last asked for has become the arm's: what has come clear must stay clear.
  void Adopt() noexcept;

  // Of the pose last asked for [m]: the least distance between capsules, of the tip to the box's faces,
  // and of the lowest point to the table; margins not subtracted.
  struct Clearance {
    float self = 0, box = 0, table = 0;
  };
  Clearance clearance() const noexcept;

 private:
  static constexpr int kInstants = 16;
  using Lanes = Eigen::Array<float, kInstants, 1>;  // a quantity at all instants
  struct Vec {
    Lanes x, y, z;
  };
  struct Frame {
    std::array<Vec, 3> axis;  // columns of R_BJ
    Vec p;
  };
  static constexpr int kNumPairs = static_cast<int>(lite6_shape::kPairs.size());
  static constexpr int kNumBodies =
      static_cast<int>(lite6_shape::kCylinders.size() + lite6_shape::kBoxes.size());
  static constexpr int kNumClearances = kNumPairs + kNumBodies + 6;

  bool Free(const AxisStates& s, double jerk_factor) noexcept;
  static Vec Place(const Frame& f, const float* p) noexcept;
  static Lanes SegmentDistance(const Vec& p0, const Vec& p1, const Vec& q0, const Vec& q1) noexcept;

  // Clearances less margins at all instants; the tip's speed there.
  void Evaluate(const std::array<Lanes, kNumJoints>& q, const std::array<Lanes, kNumJoints>& dq) noexcept;
  void Keep(int i, const Lanes& clearance) noexcept {
    now_[i] = clearance[0];
    least_[i] = clearance.minCoeff();
  }

  std::array<AxisLimits, kNumJoints> limits_;
  ArmSpace space_;
  struct Fixed {
    float R[3][3], p[3];
  };
  std::array<Fixed, kNumJoints> X_PJ_;
  float p_EG_[3];

  std::array<float, kNumClearances> now_{}, least_{};  // of the pose asked for; along its stop
  std::array<float, kNumClearances> floor_{};          // what least_ may not go below: 0, or less after Reset
  float tip_speed_ = 0;                                // the highest along the stop [m/s]
};

}  // namespace intabs
