// Gaps in tracks of poses and points: what lies between two measurements, and what lies after the last one.
//
// Offline (FillGaps, FillPointGaps): position by a Kalman filter and a Rauch-Tung-Striebel smoother over the
// whole run (white jerk, the three axes alike); orientation by SLERP over short gaps, by a cubic of the
// rotation vector that keeps the turning rates on both sides over longer ones. Or the thesis' linear + SLERP.
// Causal (GapTracker): position and rotation by Kalman filters whose velocity dies away, so that a prediction
// goes on at first and holds later, with a covariance that grows. Gaps longer than max_gap are not filled:
// nobody knows what happened in them.
#pragma once

#include <cstdint>
#include <span>

#include "intabs/core/pose.h"

namespace intabs {

enum class SampleState : uint8_t {
  kInvalid = 0,
  kMeasured = 1,
  kFilled = 2,
};

enum class GapMethod {
  kKalman,  // the default
  kLinear,  // the thesis': linear, SLERP
};

struct GapOptions {
  GapMethod method = GapMethod::kKalman;
  // A gap's length is the time between the measurements around it [s].
  double max_gap = 0.5;
  double slerp_gap = 0.4;  // up to here SLERP, beyond it the rate-fitted log map [s]
  double sigma = 0.002;    // of one coordinate of a measured position [m]
  // Spectral density of the white jerk [m^2/s^5]. Minimum-jerk reaches of .25 to .5 m in .7 to 1.1 s: errors
  // in gaps of .1 to .4 s stay within 10 % of the least from 5 to 30.
  double jerk_density = 15.0;
};

// time: strictly rising [s]. pose: in, what was measured where state is kMeasured, anything elsewhere; out,
// filled where a gap was. state: in, kMeasured or anything else; out, kFilled where filled, kInvalid where
// not. sigma, empty or one a sample: out, standard deviation of a coordinate of the position [m], 0 where
// invalid; for kLinear that of a measurement everywhere. Measured poses stay as they are; before the first
// and after the last measurement nothing is filled. Throws std::invalid_argument, one line, for sizes that
// differ, time that does not rise, a measured pose that is not finite or whose quaternion is not of unit
// norm. Allocates.
void FillGaps(std::span<const double> time, std::span<Pose> pose, std::span<SampleState> state,
              const GapOptions& options = {}, std::span<double> sigma = {});

// The same for points (key points of a hand).
void FillPointGaps(std::span<const double> time, std::span<Eigen::Vector3d> point,
                   std::span<SampleState> state, const GapOptions& options = {},
                   std::span<double> sigma = {});

struct GapTrackerOptions {
  double max_gap = 0.5;         // a prediction is valid for so long [s]
  double sigma = 0.002;         // of a coordinate of a measured position [m]
  double sigma_angle = 0.0175;  // of a coordinate of a measured rotation vector [rad]
  // Velocity decays with this time constant [s]: hands and what they hold soon stop.
  double decay = 0.3;
  double speed_sigma = 0.3;          // of a coordinate of the velocity of what moves [m/s]
  double angular_speed_sigma = 0.6;  // [rad/s]
};

struct GapEstimate {
  Pose pose;
  double sigma = 0;        // of a coordinate of the position [m]
  double sigma_angle = 0;  // of a coordinate of the rotation vector [rad]
  double age = 0;          // since the last measurement [s]
  bool valid = false;      // measured at least once and age <= max_gap
};

// The causal variant: one track, measurements as they come. Real-time safe.
class GapTracker {
 public:
  explicit GapTracker(const GapTrackerOptions& options = {}) : options_(options) {}

  // Takes a measurement at `time` [s]. False, and nothing changes, when time does not rise, the pose is not
  // finite or a deviation is not positive. After more than max_gap it starts anew.
  [[nodiscard]] bool Update(double time, const Pose& measured) noexcept {
    return Update(time, measured, options_.sigma, options_.sigma_angle);
  }
  // The same for one that is as good as sigma [m] and sigma_angle [rad] say.
  [[nodiscard]] bool Update(double time, const Pose& measured, double sigma, double sigma_angle) noexcept;
  // The estimate for a time not before the last measurement (earlier ones get that of the last measurement).
  [[nodiscard]] GapEstimate Predict(double time) const noexcept;
  void Reset() noexcept { seen_ = false; }

 private:
  // Covariance of (place, velocity), the same for the three axes.
  struct Axis {
    double pp = 0, pv = 0, vv = 0;
    void Advance(double dt, double decay, double speed_sigma) noexcept;
  };
  void Advance(double dt, Pose& X, Eigen::Vector3d& v, Eigen::Vector3d& w, Axis& place,
               Axis& turn) const noexcept;

  GapTrackerOptions options_;
  bool seen_ = false;
  double time_ = 0;
  Pose X_;
  Eigen::Vector3d v_ = Eigen::Vector3d::Zero();  // velocity of p_WO [m/s]
  Eigen::Vector3d w_ = Eigen::Vector3d::Zero();  // angular velocity in O [rad/s]
  Axis place_, turn_;
};

}  // namespace intabs
