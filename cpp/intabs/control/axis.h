// Jerk-limited motion of one joint, in closed form and continuous time. Real-time safe.
#pragma once

#include <algorithm>
#include <cmath>

namespace intabs {

struct AxisState {
  double x = 0, v = 0, a = 0;  // [rad], [rad/s], [rad/s^2]
};

// The fastest way from speed v and acceleration a to a constant speed: jerk +-j for t1, none for t2, -+j for
// t3.
struct SpeedChange {
  double jerk = 0;  // of the first piece, with its sign
  double t1 = 0, t2 = 0, t3 = 0;
  double speed = 0;  // at the end

  // a_max and j_max positive, |a| <= a_max.
  SpeedChange(double v, double a, double speed_wanted, double a_max, double j_max) noexcept
      : speed(speed_wanted) {
    // Mirrored so that the speed has to rise even after the acceleration has been let go.
    const double sign = speed_wanted >= v + a * std::abs(a) / (2 * j_max) ? 1 : -1;
    const double a0 = sign * a, dv = sign * (speed_wanted - v);
    double peak = std::sqrt(std::max(0.0, j_max * dv + 0.5 * a0 * a0));
    if (peak > a_max) {
      peak = a_max;
      t2 = std::max(0.0, (dv - (2 * a_max * a_max - a0 * a0) / (2 * j_max)) / a_max);
    }
    jerk = sign * j_max;
    t1 = std::max(0.0, (peak - a0) / j_max);
    t3 = peak / j_max;
  }

  double duration() const noexcept { return t1 + t2 + t3; }

  // Where `s`, which this was made from, is after t >= 0.
  AxisState After(AxisState s, double t) const noexcept {
    const double d1 = std::min(t, t1), d2 = std::clamp(t - t1, 0.0, t2),
                 d3 = std::clamp(t - t1 - t2, 0.0, t3);
    Advance(s, jerk, d1);
    Advance(s, 0, d2);
    Advance(s, -jerk, d3);
    if (const double rest = t - duration(); rest >= 0) {
      s.v = speed;
      s.a = 0;
      s.x += speed * rest;
    }
    return s;
  }

  static void Advance(AxisState& s, double jerk, double t) noexcept {
    s.x += t * (s.v + t * (s.a / 2 + t * jerk / 6));
    s.v += t * (s.a + t * jerk / 2);
    s.a += t * jerk;
  }
};

struct AxisLimits {
  double v, a, j;  // [rad/s], [rad/s^2], [rad/s^3]
};

// Where the fastest stop within the limits ends [rad].
inline double StopEnd(const AxisState& s, const AxisLimits& l) noexcept {
  const SpeedChange stop(s.v, s.a, 0, l.a, l.j);
  AxisState end = s;
  SpeedChange::Advance(end, stop.jerk, stop.t1);
  SpeedChange::Advance(end, 0, stop.t2);
  SpeedChange::Advance(end, -stop.jerk, stop.t3);
  return end.x;
}

// Where the way of that stop turns round before its end, if it does; else where it ends.
inline double StopTurn(const AxisState& s, const AxisLimits& l) noexcept {
  const double released = s.v + s.a * std::abs(s.a) / (2 * l.j);
  if (s.v * released >= 0) return StopEnd(s, l);
  // The acceleration already leads back and is let go at once: |a| falls by j until the speed is 0.
  const double sign = s.a > 0 ? 1 : -1;
  const double a = sign * s.a, v = sign * s.v;
  const double t = (a - std::sqrt(std::max(0.0, a * a + 2 * l.j * v))) / l.j;
  return s.x + sign * t * (v + t * (a / 2 - t * l.j / 6));
}

// One tick of `dt` towards the reference r by a third-order lag, as fast as the limits allow where that is
// slower. The place where a stop would end only ever moves towards r: a reference that stays is never passed
// by, nor is any limit on position that r keeps. `speed` <= limits.v holds but while braking from more.
// `decay` in (0, 1): what a tick leaves of a small deviation's slowest part.
AxisState StepTowards(const AxisState& s, double r, double speed, double decay, const AxisLimits& limits,
                      double dt) noexcept;

// One tick of the fastest stop.
inline AxisState StepToStop(const AxisState& s, const AxisLimits& l, double dt) noexcept {
  return SpeedChange(s.v, s.a, 0, l.a, l.j).After(s, dt);
}

// Between two states that one tick can lead to: itself such a state, since the limits are convex.
inline AxisState Mix(const AxisState& from, const AxisState& to, double share) noexcept {
  return {from.x + share * (to.x - from.x), from.v + share * (to.v - from.v),
          from.a + share * (to.a - from.a)};
}

}  // namespace intabs
