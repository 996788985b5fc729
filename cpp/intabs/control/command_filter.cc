#include "intabs/control/command_filter.h"

#include <algorithm>
#include <cmath>

namespace intabs {
namespace {

constexpr double kDt = kDriverPeriodUs * 1e-6;
// The lag's triple pole. It trails a steady motion by 3 / (1 - kDecay) - 1 ticks: 40 ms. A shorter lag would
// not last at speed (README.md).
constexpr double kDecay = 8.0 / 11;
// From here the target is reached in one tick, exactly.
constexpr AxisState kArrived = {1e-7, 1e-5, 1e-2};

std::array<AxisLimits, kNumJoints> ByAxis(const ArmLimits& l) noexcept {
  std::array<AxisLimits, kNumJoints> axes;
  for (int i = 0; i < kNumJoints; ++i) axes[i] = {l.dq_max[i], l.ddq_max[i], l.dddq_max[i]};
  return axes;
}

}  // namespace

CommandFilter::CommandFilter(const ArmLimits& limits, const ArmModel& model) noexcept
    : limits_(limits), model_(model), axes_(ByAxis(limits)), guard_(model, limits.space, axes_) {
  Reset(JointVector::Zero());
}

void CommandFilter::Reset(const JointVector& q) noexcept {
  for (int i = 0; i < kNumJoints; ++i) state_[i] = {q[i], 0, 0};
  low_ = limits_.q_min.cwiseMin(q);
  high_ = limits_.q_max.cwiseMax(q);
  target_ = path_ = q;
  ticks_left_ = 1;
  blocked_ = halting_ = halt_decided_ = halted_ = false;
  guard_.Reset(q);
  Adopt(state_);
}

void CommandFilter::SetTarget(const JointVector& q_target, int ticks) noexcept {
  target_ = q_target.cwiseMax(low_).cwiseMin(high_);
  // One to spare: the next target may be a tick late and still find the path point moving.
  ticks_left_ = ticks > 2 ? ticks + 1 : std::max(1, ticks);
}

void CommandFilter::AdvancePathPoint(const JointVector& dq_max) noexcept {
  const JointVector way = target_ - path_;
  const int ticks = ticks_left_;
  if (ticks_left_ > 1) --ticks_left_;
  if (way.cwiseAbs().maxCoeff() < 1e-9) {
    path_ = target_;
    return;
  }
  const JointVector step = way / ticks;
  double share = 1;
  for (int i = 0; i < kNumJoints; ++i) {
    if (std::abs(step[i]) > dq_max[i] * kDt) share = std::min(share, dq_max[i] * kDt / std::abs(step[i]));
  }
  const double tip_way = (model_.Jacobian(q_).topRows<3>() * step).norm();
  if (tip_way > limits_.tcp_speed_max * kDt) share = std::min(share, limits_.tcp_speed_max * kDt / tip_way);
  path_ += share * step;
}

void CommandFilter::Follow(const JointVector& dq_max) noexcept {
  if (halting_) {
    HaltStep();
    return;
  }
  halted_ = false;
  if (!blocked_) AdvancePathPoint(dq_max);
  AxisStates next, stop;
  for (int i = 0; i < kNumJoints; ++i) {
    const AxisState& s = state_[i];
    stop[i] = StepToStop(s, axes_[i], kDt);
    next[i] = StepTowards(s, path_[i], std::min(dq_max[i], axes_[i].v), kDecay, axes_[i], kDt);
    const double turn = StopTurn(next[i], axes_[i]);
    if (turn < low_[i] || turn > high_[i]) next[i] = stop[i];
    if (path_[i] == target_[i] && std::abs(next[i].x - target_[i]) < kArrived.x &&
        std::abs(next[i].v) < kArrived.v && std::abs(next[i].a) < kArrived.a &&
        std::abs(s.a) <= axes_[i].j * kDt) {
      next[i] = {target_[i], 0, 0};
    }
  }
  blocked_ = false;
  if (!guard_.StopIsFree(next)) {
    blocked_ = true;
    for (int i = 0; i < kNumJoints; ++i) next[i] = Mix(stop[i], next[i], 0.5);
    if (!guard_.StopIsFree(next)) {
      Brake();
      return;
    }
  }
  guard_.Adopt();
  Adopt(next);
}

void CommandFilter::Brake() noexcept {
  if (halting_) {
    HaltStep();
    return;
  }
  halted_ = false;
  AxisStates next;
  for (int i = 0; i < kNumJoints; ++i) {
    next[i] = StepToStop(state_[i], axes_[i], kDt);
    path_[i] = std::clamp(StopEnd(next[i], axes_[i]), low_[i], high_[i]);
  }
  ticks_left_ = 1;
  blocked_ = false;
  Adopt(next);
}

void CommandFilter::Halt() noexcept {
  if (!halt_decided_ && !at_rest_) {
    AxisStates let_go = state_;
    for (AxisState& s : let_go) s.a = 0;
    halting_ = guard_.HaltIsFree(let_go);
    halt_decided_ = true;
  }
  Brake();
}

void CommandFilter::HaltStep() noexcept {
  halted_ = true;
  AxisStates next;
  for (int i = 0; i < kNumJoints; ++i) {
    const AxisState& s = state_[i];
    const double a = std::clamp(-s.v / kDt, -axes_[i].a, axes_[i].a);
    const bool rests = std::abs(s.v) <= axes_[i].a * kDt;
    const double v = rests ? 0 : s.v + a * kDt;
    // The last piece ends within the tick: so it is no longer than that of any other stop.
    const double way = rests ? s.v * std::abs(s.v) / (2 * axes_[i].a) : 0.5 * (s.v + v) * kDt;
    next[i] = {s.x + way, v, v == 0 ? 0 : a};
    path_[i] = next[i].x;
  }
  ticks_left_ = 1;
  blocked_ = false;
  Adopt(next);
}

void CommandFilter::Adopt(const AxisStates& next) noexcept {
  state_ = next;
  at_rest_ = true;
  for (int i = 0; i < kNumJoints; ++i) {
    q_[i] = next[i].x;
    dq_[i] = next[i].v;
    ddq_[i] = next[i].a;
    at_rest_ &= next[i].v == 0 && next[i].a == 0;
    low_[i] = std::max(low_[i], std::min(limits_.q_min[i], q_[i]));
    high_[i] = std::min(high_[i], std::max(limits_.q_max[i], q_[i]));
  }
  if (at_rest_) halting_ = halt_decided_ = false;
}

}  // namespace intabs
