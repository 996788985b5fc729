#include "intabs/control/joint_filter.h"

#include <catch2/catch.hpp>
#include <random>

namespace intabs {
namespace {

constexpr double kDt = 0.004;

// Follows a reference through the filter and keeps the worst of everything.
struct Watch {
  explicit Watch(const JointFilter& f) : filter(f), x(f.position()), v(f.velocity()) {}

  void Look() {
    const ArmLimits& l = filter.limits();
    beyond_position = std::max({beyond_position, (filter.position() - l.q_max).maxCoeff(),
                                (l.q_min - filter.position()).maxCoeff()});
    beyond_speed = std::max(beyond_speed, (filter.velocity().cwiseAbs() - l.dq_max).maxCoeff());
    beyond_acceleration = std::max(
        beyond_acceleration, ((filter.velocity() - v) / kDt).cwiseAbs().maxCoeff() - l.ddq_max.maxCoeff());
    inconsistent =
        std::max(inconsistent, ((filter.position() - x) - filter.velocity() * kDt).cwiseAbs().maxCoeff());
    const double speed = (model.Tip(filter.position()).p - model.Tip(x).p).norm() / kDt;
    tcp_speed = std::max(tcp_speed, speed);
    fast_ticks += speed > 1.01 * l.tcp_speed_max;
    ++ticks;
    x = filter.position();
    v = filter.velocity();
  }

  const JointFilter& filter;
  ArmModel model = ArmModel::Lite6();
  JointVector x, v;
  double beyond_position = -1e9, beyond_speed = -1e9, beyond_acceleration = -1e9, inconsistent = 0,
         tcp_speed = 0;
  int64_t ticks = 0, fast_ticks = 0;
};

JointVector RandomPose(std::mt19937& random, const ArmLimits& l) {
  std::uniform_real_distribution<double> u(0, 1);
  return JointVector::NullaryExpr(
      [&](Eigen::Index i) { return l.q_min[i] + u(random) * (l.q_max[i] - l.q_min[i]); });
}

}  // namespace

TEST_CASE("Braking from the braking speed ends at the limit, never beyond, and any faster ends beyond") {
  std::mt19937 random(1);
  std::uniform_real_distribution<double> exponent(-9, 1);
  for (int k = 0; k < 20000; ++k) {
    const double distance = std::pow(10, exponent(random)), a = std::pow(10, exponent(random) / 4 + 1);
    const auto way = [&](double v) {
      double x = 0;
      for (; v > 0; v -= a * kDt) x += v * kDt;
      return x;
    };
    const double v = BrakingSpeed(distance, a, kDt);
    INFO("distance " << distance << " a " << a << " v " << v);
    REQUIRE(way(v) <= distance * (1 + 1e-9));
    REQUIRE(way(v * (1 + 1e-6)) > distance);
  }
  CHECK(BrakingSpeed(0, 20, kDt) == 0);
  CHECK(BrakingSpeed(-1, 20, kDt) == 0);
}

TEST_CASE("Random target streams never drive the reference beyond position, speed or acceleration limits") {
  const ArmLimits limits;
  std::uniform_real_distribution<double> u(0, 1);
  for (int seed = 0; seed < 20; ++seed) {
    std::mt19937 random(seed);
    JointFilter filter(limits, ArmModel::Lite6());
    filter.Reset(RandomPose(random, limits));
    Watch watch(filter);
    JointVector target = filter.position(), dq_max = limits.dq_max;
    int hold = 0, brake = 0;
    for (int tick = 0; tick < 10000; ++tick) {
      if (--hold < 0) {
        hold = static_cast<int>(std::pow(200, u(random)));
        const double kind = u(random);
        if (kind < 0.2) {
          target = RandomPose(random, limits);
        } else if (kind < 0.3) {  // far beyond limits
          target = 3 * RandomPose(random, limits);
        } else if (kind < 0.5) {  // exactly at limits
          target = JointVector::NullaryExpr(
              [&](Eigen::Index i) { return u(random) < 0.5 ? limits.q_min[i] : limits.q_max[i]; });
        } else if (kind < 0.9) {  // small steps
          target = (target + 0.1 * (RandomPose(random, limits) - target)).eval();
        } else {
          brake = hold;
        }
        dq_max = JointVector::NullaryExpr([&] { return u(random) < 0.8 ? 2.14 : 2.14 * u(random) + 1e-6; });
      }
      if (--brake > 0) {
        filter.Brake();
      } else {
        filter.Follow(target, dq_max);
      }
      watch.Look();
    }
    INFO("seed " << seed);
    CHECK(watch.beyond_position <= 1e-9);
    CHECK(watch.beyond_speed <= 1e-9);
    CHECK(watch.beyond_acceleration <= 1e-9);
    CHECK(watch.inconsistent <= 2e-7);  // the last hop onto the target is shorter than 1e-7 rad
    CHECK(watch.tcp_speed <= 0.6);      // the controller's guard
    // Aimed at 0.5 m/s. Where joints cannot brake at once without breaking the acceleration limit it is a
    // little over.
    CHECK(watch.fast_ticks <= watch.ticks / 100);
    CAPTURE(watch.tcp_speed, watch.fast_ticks);
    CHECK(watch.tcp_speed > 0.45);  // the streams do reach it
  }
}

TEST_CASE("A held target is reached without overshoot, exactly, and kept at rest") {
  const ArmLimits limits;
  for (int seed = 0; seed < 200; ++seed) {
    std::mt19937 random(seed);
    JointFilter filter(limits, ArmModel::Lite6());
    const JointVector start = RandomPose(random, limits);
    // From far away to less than a millimetre's worth.
    const double share = std::pow(10, -4.0 * (seed % 5) / 4);
    const JointVector target = start + share * (RandomPose(random, limits) - start);
    filter.Reset(start);
    int ticks = 0;
    while (!(filter.position() == target && filter.at_rest()) && ++ticks < 20000) {
      filter.Follow(target, limits.dq_max);
      for (int i = 0; i < kNumJoints; ++i) {
        const double way = target[i] - start[i], passed = filter.position()[i] - start[i];
        if (passed * std::copysign(1.0, way) > std::abs(way) + 1e-12) {
          FAIL("seed " << seed << " joint " << i << " overshoots by " << passed - way);
        }
      }
    }
    INFO("seed " << seed);
    REQUIRE(filter.position() == target);
    REQUIRE(filter.at_rest());
    filter.Follow(target, limits.dq_max);
    CHECK(filter.position() == target);
    CHECK(filter.at_rest());
  }
}

TEST_CASE("A slow and a fast joint go straight: the TCP limit scales the whole motion") {
  JointFilter filter(ArmLimits{}, ArmModel::Lite6());
  JointVector start;
  start << 0, 0.3, 1.0, 0, 0.7, 0;
  filter.Reset(start);
  JointVector target = start;
  target[0] += 2;
  Watch watch(filter);
  for (int i = 0; i < 200; ++i) {
    filter.Follow(target, filter.limits().dq_max);
    watch.Look();
  }
  // Joint 1 alone, far out: the speed is the limit's, not the joint's.
  CHECK(watch.tcp_speed == Approx(0.5).epsilon(0.01));
}

TEST_CASE("From outside the position limits the reference only moves inward") {
  const ArmLimits limits;
  JointFilter filter(limits, ArmModel::Lite6());
  JointVector q = JointVector::Zero();
  q[1] = limits.q_max[1] + 0.02;
  filter.Reset(q);
  JointVector target = JointVector::Zero();
  target[1] = limits.q_max[1];
  double last = q[1];
  for (int i = 0; i < 300; ++i) {
    filter.Follow(target, limits.dq_max);
    CHECK(filter.position()[1] <= last);
    last = filter.position()[1];
  }
  CHECK(filter.position() == target);
}

}  // namespace intabs
