#include "intabs/control/joint_filter.h"

#include <algorithm>
#include <cmath>

namespace intabs {
namespace {

constexpr double kDt = kDriverPeriodUs * 1e-6;
// A target's step is followed like a first-order lag of this time constant [s]: as long as the policy's
// period, so that the steps of 25 Hz melt into one motion.
constexpr double kTau = 0.04;
constexpr double kArrived = 1e-7;  // [rad]: from here the target is reached in one tick, exactly

// Speed towards a target at `distance` >= 0: distance / tau near it; farther away the square root of constant
// braking, joined where both have the same slope, so that braking never asks for more than `a`.
double ApproachSpeed(double distance, double a) {
  const double knee = a * kTau * kTau;
  return distance <= knee ? distance / kTau : std::sqrt(2 * a * (distance - knee / 2));
}

}  // namespace

double BrakingSpeed(double distance, double a, double dt) noexcept {
  if (!(distance > 0)) return 0;
  // Braking from v takes the steps v, v - a dt, v - 2 a dt, ... > 0. With n of them after this one the way is
  // (n + 1) v dt - n (n + 1) / 2 a dt^2; n is that of the speed n a dt, whose way is n (n + 1) / 2 a dt^2.
  const double n = std::floor((std::sqrt(1 + 8 * distance / (a * dt * dt)) - 1) / 2);
  return distance / ((n + 1) * dt) + n / 2 * a * dt;
}

void JointFilter::Reset(const JointVector& q) noexcept {
  x_ = q;
  v_.setZero();
}

void JointFilter::Follow(const JointVector& q_target, const JointVector& dq_max) noexcept {
  const JointVector error = q_target - x_;
  const JointVector dv = limits_.ddq_max * kDt;
  if (error.cwiseAbs().maxCoeff() < kArrived && (v_.cwiseAbs().array() <= 0.5 * dv.array()).all()) {
    x_ = q_target;
    v_.setZero();
    return;
  }
  JointVector wanted;
  for (int i = 0; i < kNumJoints; ++i) {
    const double speed = std::min(ApproachSpeed(std::abs(error[i]), limits_.ddq_max[i]), dq_max[i]);
    wanted[i] = std::copysign(speed, error[i]);
  }
  Step(wanted);
}

void JointFilter::Brake() noexcept {
  if (!at_rest()) Step(JointVector::Zero());
}

void JointFilter::Step(const JointVector& wanted) noexcept {
  const auto J = model_.Jacobian(x_).topRows<3>().eval();
  const auto tcp_speed = [&J](const JointVector& v) { return (J * v).norm(); };

  // What the acceleration limits allow. Braking is always in it, and keeps the position limits (see below).
  const JointVector dv = limits_.ddq_max * kDt;
  const JointVector low = v_ - dv, high = v_ + dv;
  const auto within = [&](const JointVector& v) { return JointVector(v.cwiseMax(low).cwiseMin(high)); };

  // A wish that is too fast for the TCP keeps its direction.
  const double wanted_speed = tcp_speed(wanted);
  const double fit = wanted_speed > limits_.tcp_speed_max ? limits_.tcp_speed_max / wanted_speed : 1;
  JointVector next = within(wanted * fit);

  // Never so fast that full braking would end beyond a limit. Where that held for the last tick it can be
  // kept now: the speed it asks for is at most one dv below.
  for (int i = 0; i < kNumJoints; ++i) {
    const double up =
        std::min(limits_.dq_max[i], BrakingSpeed(limits_.q_max[i] - x_[i], limits_.ddq_max[i], kDt));
    const double down =
        std::min(limits_.dq_max[i], BrakingSpeed(x_[i] - limits_.q_min[i], limits_.ddq_max[i], kDt));
    next[i] = std::clamp(next[i], -down, up);
  }

  // While the joints are on their way to the wish, the TCP may still be too fast: take the largest part of it
  // that is not. within() leaves every joint between `next` and full braking, so that all of the above still
  // holds.
  if (tcp_speed(next) > limits_.tcp_speed_max) {
    double part = 0, too_much = 1;
    for (int i = 0; i < 12; ++i) {
      const double middle = 0.5 * (part + too_much);
      (tcp_speed(within(next * middle)) > limits_.tcp_speed_max ? too_much : part) = middle;
    }
    next = within(next * part);
  }
  v_ = next;
  x_ += v_ * kDt;
}

}  // namespace intabs
