#include "intabs/control/axis.h"

#include <catch2/catch.hpp>
#include <random>

namespace intabs {
namespace {

constexpr AxisLimits kLimits = {2.14, 20, 500};
constexpr double kDt = 0.004;

// A state that keeps the limits: |a| can be let go before the speed is beyond.
AxisState RandomState(std::mt19937& random) {
  std::uniform_real_distribution<double> u(-1, 1);
  while (true) {
    const AxisState s{u(random), kLimits.v * u(random), kLimits.a * std::pow(u(random), 3)};
    if (std::abs(s.v + s.a * std::abs(s.a) / (2 * kLimits.j)) <= kLimits.v) return s;
  }
}

}  // namespace

TEST_CASE("A speed change ends at its speed, keeps the limits on the way, and no other way is faster") {
  std::mt19937 random(1);
  for (int k = 0; k < 20000; ++k) {
    const AxisState s = RandomState(random);
    const double wanted = RandomState(random).v;
    const SpeedChange c(s.v, s.a, wanted, kLimits.a, kLimits.j);
    INFO("v " << s.v << " a " << s.a << " to " << wanted);
    // Integrated on its own: 2000 steps of the three pieces.
    AxisState x = s;
    const double dt = c.duration() / 2000;
    double reached = 0;
    for (int i = 0; i < 2000; ++i) {
      const double t = (i + 0.5) * dt;
      const double jerk = t < c.t1 ? c.jerk : t < c.t1 + c.t2 ? 0 : -c.jerk;
      x.v += dt * (x.a + 0.5 * dt * jerk);
      x.a += dt * jerk;
      reached = std::max(reached, std::abs(x.a));
    }
    REQUIRE(x.v == Approx(wanted).margin(0.02));  // the pieces' ends fall between steps
    REQUIRE(x.a == Approx(0).margin(1.5 * kLimits.j * dt));
    REQUIRE(reached <= kLimits.a + 1.5 * kLimits.j * dt);
    const AxisState end = c.After(s, c.duration());
    REQUIRE(end.v == wanted);
    REQUIRE(end.a == 0);
    // Bang-bang: full jerk, or full acceleration, until the end.
    REQUIRE((c.t2 == 0 || std::abs(s.a + c.jerk * c.t1) == Approx(kLimits.a)));
    REQUIRE(std::abs(s.a + c.jerk * (c.t1 - c.t3)) < 1e-9);
    const AxisState shortly_before = c.After(s, c.duration() * (1 - 1e-9));
    REQUIRE(shortly_before.v == Approx(wanted).margin(1e-6));
  }
}

TEST_CASE("A stop begun and recomputed every tick ends where it was said to") {
  std::mt19937 random(2);
  for (int k = 0; k < 5000; ++k) {
    AxisState s = RandomState(random);
    const double end = StopEnd(s, kLimits), turn = StopTurn(s, kLimits);
    double low = s.x, high = s.x;
    INFO("v " << s.v << " a " << s.a);
    for (int i = 0; i < 400 && !(s.v == 0 && s.a == 0); ++i) {
      const AxisState before = s;
      s = StepToStop(s, kLimits, kDt);
      REQUIRE(std::abs(s.a) <= kLimits.a + 1e-9);
      REQUIRE(std::abs(s.a - before.a) <= kLimits.j * kDt + 1e-9);
      REQUIRE(StopEnd(s, kLimits) == Approx(end).margin(1e-10));
      low = std::min(low, s.x);
      high = std::max(high, s.x);
    }
    REQUIRE(s.v == 0);
    REQUIRE(s.a == 0);
    REQUIRE(s.x == Approx(end).margin(1e-10));
    // Between ticks it may go a hair further.
    const double far_low = std::min({end, turn}), far_high = std::max({end, turn});
    if (turn < end) REQUIRE(low == Approx(far_low).margin(5e-5));
    if (turn > end) REQUIRE(high == Approx(far_high).margin(5e-5));
  }
}

TEST_CASE("A step towards a reference never lets the stop end beyond it, nor further away than before") {
  std::mt19937 random(3);
  std::uniform_real_distribution<double> u(0, 1);
  for (int k = 0; k < 200000; ++k) {
    const AxisState s = RandomState(random);
    const double end = StopEnd(s, kLimits);
    const double r = end + std::pow(10, -6 * u(random)) * (u(random) < 0.5 ? -1 : 1);
    const double speed = u(random) < 0.7 ? kLimits.v : kLimits.v * u(random);
    const AxisState n = StepTowards(s, r, speed, 8.0 / 11, kLimits, kDt);
    const double new_end = StopEnd(n, kLimits);
    INFO("x " << s.x << " v " << s.v << " a " << s.a << " r " << r << " speed " << speed);
    REQUIRE(new_end >= std::min(end, r) - 1e-9);
    REQUIRE(new_end <= std::max(end, r) + 1e-9);
    REQUIRE(std::abs(n.a) <= kLimits.a + 1e-9);
    REQUIRE(std::abs(n.a - s.a) <= kLimits.j * kDt + 1e-9);
    REQUIRE(std::abs(n.v + n.a * std::abs(n.a) / (2 * kLimits.j)) <= kLimits.v + 1e-9);
    // The motion within the tick is one of limited jerk: from the three end values its mean speed is bounded.
    REQUIRE(std::abs((n.x - s.x) - kDt * (s.v + kDt * (2 * s.a + n.a) / 6)) <= kLimits.j * kDt * kDt * kDt);
  }
}

TEST_CASE("A mean of two possible steps keeps the limits too") {
  std::mt19937 random(4);
  for (int k = 0; k < 50000; ++k) {
    const AxisState s = RandomState(random);
    const AxisState stop = StepToStop(s, kLimits, kDt), go = StepTowards(s, 9, kLimits.v, 0.7, kLimits, kDt);
    const AxisState half = Mix(stop, go, 0.5);
    REQUIRE(std::abs(half.a - s.a) <= kLimits.j * kDt + 1e-9);
    REQUIRE(std::abs(half.v + half.a * std::abs(half.a) / (2 * kLimits.j)) <= kLimits.v + 1e-9);
    REQUIRE(StopEnd(half, kLimits) <= 0.5 * (StopEnd(stop, kLimits) + StopEnd(go, kLimits)) + 1e-9);
  }
}

}  // namespace intabs
