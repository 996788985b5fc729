#include "intabs/control/axis.h"

namespace intabs {
namespace {

// The third-order lag: state feedback on (x - r, v, a) with the jerk constant over a tick, three discrete
// poles at `decay`. Its zeros are negative, so its answer is a weighted mean of past references: no
// overshoot.
double LagJerk(const AxisState& s, double r, double decay, double dt) noexcept {
  const double m = 1 - decay;
  const double kx = m * m * m / (dt * dt * dt);
  const double kv = (3 * m * m - m * m * m) / (dt * dt);
  const double ka = (3 * m - 1.5 * m * m + m * m * m / 3) / dt;
  return -kx * (s.x - r) - kv * s.v - ka * s.a;
}

}  // namespace

AxisState StepTowards(const AxisState& s, double r, double speed, double decay, const AxisLimits& l,
                      double dt) noexcept {
  const double end = StopEnd(s, l);
  const double low = std::min(end, r), high = std::max(end, r);

  // What the lag asks for, if the stop after it ends between where it ends now and r.
  const double jerk = std::clamp(LagJerk(s, r, decay, dt), std::max(-l.j, (-l.a - s.a) / dt),
                                 std::min(l.j, (l.a - s.a) / dt));
  AxisState lagged = s;
  SpeedChange::Advance(lagged, jerk, dt);
  const double lagged_end = StopEnd(lagged, l);
  const double released = lagged.v + lagged.a * std::abs(lagged.a) / (2 * l.j);
  if (lagged_end >= low && lagged_end <= high && std::abs(released) <= speed && std::abs(lagged.v) <= speed &&
      std::abs(lagged.x - s.x) <= speed * dt) {
    return lagged;
  }

  // Else as fast as possible without a stop beyond r: between the stop and the highest acceleration.
  const AxisState stop = StepToStop(s, l, dt);
  const double sign = r >= end ? 1 : -1;
  const AxisState fast = SpeedChange(s.v, s.a, sign * speed, l.a, l.j).After(s, dt);
  double beyond = sign * (StopEnd(fast, l) - r);
  if (beyond <= 0) return fast;
  double before = sign * (StopEnd(stop, l) - r);  // <= 0 but for rounding
  if (before >= 0) return stop;
  // Regula falsi (Illinois); the function rises.
  double share_before = 0, share_beyond = 1;
  int side = 0;
  for (int i = 0; i < 12 && before < -1e-13; ++i) {
    const double share = (share_before * beyond - share_beyond * before) / (beyond - before);
    const double value = sign * (StopEnd(Mix(stop, fast, share), l) - r);
    if (value > 0) {
      share_beyond = share;
      beyond = value;
      if (side == 1) before /= 2;
      side = 1;
    } else {
      share_before = share;
      before = value;
      if (side == -1) beyond /= 2;
      side = -1;
    }
  }
  return Mix(stop, fast, share_before);
}

}  // namespace intabs
