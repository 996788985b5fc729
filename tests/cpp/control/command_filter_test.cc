#include "intabs/control/command_filter.h"

#include <catch2/catch.hpp>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <random>
#include <sstream>
#include <vector>

#include "common/alloc_hook.h"
#include "random_streams.h"
#include "reference_shape.h"

namespace intabs {
namespace {

constexpr double kDt = 0.004;
const ArmLimits kLimits;
const ArmModel kModel = ArmModel::Lite6();

JointVector Joints(double a, double b, double c, double d, double e, double f) {
  JointVector q;
  q << a, b, c, d, e, f;
  return q;
}
const JointVector kHome = Joints(0, 0.2, 1.0, 0, 0.8, 0);

// Somewhere around home, clear of everything on the straight way from there.
JointVector NearHome(std::mt19937& random, double reach = 0.5) {
  std::uniform_real_distribution<double> u(-1, 1);
  return kHome + JointVector::NullaryExpr(
                     [&](Eigen::Index i) { return (i == 0 || i > 2 ? 1 : 0.4) * reach * u(random); });
}

double Most(const JointVector& v) { return v.cwiseAbs().maxCoeff(); }

// 25 Hz targets that the shipped weights gave in four pick-and-place runs.
std::vector<std::vector<JointVector>> PolicyRuns() {
  std::ifstream in(INTABS_SOURCE_DIR "/tests/cpp/control/policy_targets.csv");
  std::vector<std::vector<JointVector>> runs(1);
  for (std::string line; std::getline(in, line);) {
    if (line.empty()) {
      runs.emplace_back();
      continue;
    }
    std::stringstream fields(line);
    JointVector q;
    for (int i = 0; i < kNumJoints; ++i) {
      std::string field;
      std::getline(fields, field, ',');
      q[i] = std::stod(field);
    }
    runs.back().push_back(q);
  }
  return runs;
}

}  // namespace

TEST_CASE("Random streams of commands violate no limit: 10^6 ticks") {
  StreamFigures f;
  for (uint64_t number = 0; f.ticks < 1000000; ++number) {
    const std::string fault = RunStream(number, f);
    if (!fault.empty()) FAIL("stream " << number << ": " << fault);
  }
  // It once left a position limit by 1 um: the declared stop's last tick was longer than it had to be.
  CHECK(RunStream(723607, f) == "");
  // They do go to the limits.
  CHECK(f.max_speed > 2.1399);
  CHECK(f.max_acceleration > 19.999);
  CHECK(f.max_jerk > 499.99);
  CHECK(f.max_tcp > 0.57);
  CHECK(f.min_self < 0.011);
  CHECK(f.min_table < 0.003);
  CHECK(f.halts > 100);
  CHECK(f.blocked_ticks > 100);
}

// INTABS_STREAMS=1000000 [INTABS_FIRST_STREAM=0] control_test "[streams]"
TEST_CASE("Random streams, as many as asked for", "[.][streams]") {
  const auto number = [](const char* name, uint64_t otherwise) {
    const char* text = std::getenv(name);
    return text != nullptr ? std::strtoull(text, nullptr, 10) : otherwise;
  };
  const uint64_t first = number("INTABS_FIRST_STREAM", 0), n = number("INTABS_STREAMS", 10000);
  StreamFigures f;
  int failed = 0;
  for (uint64_t i = first; i < first + n; ++i) {
    const std::string fault = RunStream(i, f);
    if (!fault.empty()) {
      std::cout << "stream " << i << ": " << fault << "\n";
      ++failed;
    }
    if ((i - first) % 50000 == 49999)
      std::cout << i - first + 1 << " streams, " << failed << " failed" << std::endl;
  }
  std::cout << f.streams << " streams, " << f.ticks << " ticks, " << failed
            << " failed; most beyond a position limit " << f.max_position << " rad, " << f.max_speed
            << " rad/s, " << f.max_acceleration << " rad/s^2, " << f.max_jerk << " rad/s^3 outside "
            << f.halts << " declared stops, tip " << f.max_tcp << " m/s; least between capsules "
            << f.min_self << " m, above the table " << f.min_table << " m, inside the box " << f.min_box
            << " m; held back in " << f.blocked_ticks << " ticks\n";
  CHECK(failed == 0);
}

TEST_CASE("A held target is reached without overshoot, exactly, and kept at rest") {
  for (int seed = 0; seed < 300; ++seed) {
    std::mt19937 random(seed);
    CommandFilter filter(kLimits, kModel);
    const JointVector start = NearHome(random);
    // From far away to less than a micrometre's worth.
    const JointVector target = start + std::pow(10, -6.0 * (seed % 7) / 6) * (NearHome(random) - start);
    filter.Reset(start);
    filter.SetTarget(target, 1 + seed % 12);
    int ticks = 0;
    while (!(filter.position() == target && filter.at_rest()) && ++ticks < 5000) {
      filter.Follow(kLimits.dq_max);
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
    for (int i = 0; i < 10; ++i) filter.Follow(kLimits.dq_max);
    REQUIRE(filter.position() == target);
    REQUIRE(filter.at_rest());
  }
}

TEST_CASE("A stream that stops short is not overshot either") {
  for (const double speed : {0.05, 0.3, 0.8, 1.5}) {
    for (const int period : {1, 4, 10}) {
      CommandFilter filter(kLimits, kModel);
      filter.Reset(kHome);
      JointVector target = kHome;
      for (int k = 0; k < 500 / period; ++k) {
        if (k < 150 / period) target[5] += speed * period * kDt;
        filter.SetTarget(target, period);
        for (int i = 0; i < period; ++i) {
          filter.Follow(kLimits.dq_max);
          REQUIRE(filter.position()[5] <= target[5] + 1e-12);
        }
      }
      CHECK(filter.position() == target);
    }
  }
}

TEST_CASE("An even stream of targets becomes an even motion") {
  for (const double speed : {0.05, 0.3, 0.6}) {
    CommandFilter filter(kLimits, kModel);
    filter.Reset(kHome);
    JointVector target = kHome;
    double jerk = 0, a = 0;
    for (int tick = 0; tick < 250; ++tick) {
      if (tick % 10 == 0) {
        target[5] += speed * 10 * kDt;
        filter.SetTarget(target, 10);
      }
      filter.Follow(kLimits.dq_max);
      if (tick >= 100) {
        CHECK(filter.velocity()[5] == Approx(speed).epsilon(0.001));
        jerk = std::max(jerk, std::abs(filter.acceleration()[5] - a) / kDt);
      }
      a = filter.acceleration()[5];
    }
    CHECK(jerk < 5);  // of 500: the steps of 25 Hz are gone
  }
}

// The path is meant to be at target k when target k + 1 is due, 40 ms after k came; between them evenly.
TEST_CASE("A 25 Hz policy is tracked to 5 ms worth of motion, with one delay for all of it") {
  const auto runs = PolicyRuns();
  REQUIRE(runs.size() == 4);
  for (const auto& targets : runs) {
    REQUIRE(targets.size() > 150);
    CommandFilter filter(kLimits, kModel);
    filter.Reset(targets[0]);
    std::vector<JointVector> x, meant;
    double jerk = 0;
    JointVector a = JointVector::Zero();
    for (size_t k = 0; k < targets.size(); ++k) {
      filter.SetTarget(targets[k], 10);
      const JointVector& before = targets[k > 0 ? k - 1 : 0];
      for (int i = 1; i <= 10; ++i) {
        filter.Follow(kLimits.dq_max);
        CHECK_FALSE(filter.blocked());
        x.push_back(filter.position());
        meant.push_back(before + (targets[k] - before) * (i / 10.0));
        jerk = std::max(jerk, Most((filter.acceleration() - a) / kDt));
        a = filter.acceleration();
      }
    }
    double squares_of_speed = 0, top_speed = 0;
    for (size_t i = 1; i < meant.size(); ++i) {
      squares_of_speed += ((meant[i] - meant[i - 1]) / kDt).squaredNorm();
      top_speed = std::max(top_speed, ((meant[i] - meant[i - 1]) / kDt).norm());
    }
    double best_rms = 1e9, best_worst = 0, delay = 0;
    for (int half_ms = 0; half_ms < 160; ++half_ms) {
      double squares = 0, worst = 0;
      for (size_t i = 0; i < x.size(); ++i) {
        const double at = std::max(0.0, static_cast<double>(i) - half_ms * 0.0005 / kDt);
        const size_t k = std::min(static_cast<size_t>(at), meant.size() - 2);
        const double error =
            (x[i] - (meant[k] + (at - static_cast<double>(k)) * (meant[k + 1] - meant[k]))).norm();
        squares += error * error;
        worst = std::max(worst, error);
      }
      const double rms = 1000 * std::sqrt(squares / squares_of_speed);
      if (rms < best_rms) {
        best_rms = rms;
        best_worst = 1000 * worst / top_speed;
        delay = half_ms * 0.5;
      }
    }
    std::cout << "policy run: delay " << delay << " ms, rms error " << best_rms << " ms of rms speed, worst "
              << best_worst << " ms of top speed, jerk " << jerk << " rad/s^3\n";
    CHECK(best_rms <= 5);
    CHECK(best_worst <= 5);
    CHECK(delay <= 45);
    CHECK(jerk <= 500 + 1e-6);
  }
}

TEST_CASE("A slow and a fast joint go straight: the tip's limit scales the whole motion") {
  CommandFilter filter(kLimits, kModel);
  const JointVector start = Joints(0, 0.3, 1.0, 0, 0.7, 0);
  filter.Reset(start);
  JointVector target = start;
  target[0] += 2;
  filter.SetTarget(target, 10);
  double tip_speed = 0;
  Eigen::Vector3d tip = kModel.Tip(start).p;
  for (int i = 0; i < 700; ++i) {
    filter.Follow(kLimits.dq_max);
    tip_speed = std::max(tip_speed, (kModel.Tip(filter.position()).p - tip).norm() / kDt);
    tip = kModel.Tip(filter.position()).p;
  }
  // Joint 1 alone, far out: the speed is the tip's, not the joint's.
  CHECK(tip_speed == Approx(0.5).epsilon(0.05));
  REQUIRE(filter.at_rest());
  target[0] -= 1.5;
  target[5] += 0.15;
  const JointVector from = filter.position();
  filter.SetTarget(target, 10);
  for (int i = 0; i < 200; ++i) {
    filter.Follow(kLimits.dq_max);
    const JointVector gone = filter.position() - from, way = target - from;
    // Its tenth: both joints are on the same share of their way, but for the difference in their lags.
    CHECK(std::abs(gone[5] / way[5] - gone[0] / way[0]) < 0.1);
  }
}

TEST_CASE("No joint is faster than a command allows, and one that is too fast brakes") {
  CommandFilter filter(kLimits, kModel);
  filter.Reset(kHome);
  JointVector target = kHome;
  target[5] += 1.5;
  filter.SetTarget(target, 10);
  const JointVector slow = JointVector::Constant(0.3);
  for (int i = 0; i < 200; ++i) {
    filter.Follow(slow);
    CHECK(filter.velocity()[5] <= 0.3 + 1e-12);
  }
  CHECK(filter.velocity()[5] == Approx(0.3));
  for (int i = 0; i < 100; ++i) filter.Follow(kLimits.dq_max);
  REQUIRE(filter.velocity()[5] > 1);
  for (int i = 0; i < 60; ++i) filter.Follow(slow);
  CHECK(filter.velocity()[5] <= 0.3 + 1e-12);
}

TEST_CASE("Targets in the table, in the arm itself and outside the box end in front of them, at rest") {
  std::mt19937 random(8);
  int in_table = 0, in_itself = 0;
  while (in_table < 10 || in_itself < 10) {
    const JointVector target = NearHome(random, 3).cwiseMax(kLimits.q_min).cwiseMin(kLimits.q_max);
    const ReferenceClearance there = Measure(kModel, target);
    if (there.table < -0.03 && there.self > 0.03) {
      ++in_table;
    } else if (there.self < -0.03 && there.table > 0.03) {
      ++in_itself;
    } else {
      continue;
    }
    INFO("target " << target.transpose());
    CommandFilter filter(kLimits, kModel);
    filter.Reset(kHome);
    int blocked = 0;
    for (int k = 0; k < 200; ++k) {
      filter.SetTarget(target, 10);
      for (int i = 0; i < 10; ++i) {
        filter.Follow(kLimits.dq_max);
        blocked += filter.blocked();
        const ReferenceClearance c = Measure(kModel, filter.position());
        REQUIRE(c.self >= 0.0099);
        REQUIRE(c.table >= 0.0019);
      }
    }
    CHECK(blocked > 0);
    CHECK(Most(filter.velocity()) < 0.02);
    const ReferenceClearance c = Measure(kModel, filter.position());
    CHECK(std::min({c.self - 0.010, c.table - 0.002}) < 0.003);  // right in front of it
    // And out again.
    filter.SetTarget(kHome, 10);
    for (int i = 0; i < 2500; ++i) filter.Follow(kLimits.dq_max);
    CHECK(filter.position() == kHome);
  }
  ArmLimits fenced;
  fenced.space.tip_max.x() = 0.25;
  CommandFilter filter(fenced, kModel);
  filter.Reset(Joints(0, 0, 1.2, 0, 1.2, 0));
  REQUIRE(kModel.Tip(filter.position()).p.x() < 0.25);
  filter.SetTarget(Joints(0, 0.6, 1.2, 0, 0.6, 0), 10);
  for (int i = 0; i < 1000; ++i) {
    filter.Follow(kLimits.dq_max);
    REQUIRE(kModel.Tip(filter.position()).p.x() < 0.2501);
  }
  CHECK(kModel.Tip(filter.position()).p.x() > 0.24);
}

TEST_CASE("From too near to itself the arm only moves away, as from outside the position limits") {
  // The vendor's zero pose: the gripper just above the base.
  CommandFilter filter(kLimits, kModel);
  const JointVector zero = JointVector::Zero();
  filter.Reset(zero);
  const double at_start = Measure(kModel, zero).self;
  REQUIRE(at_start < 0);
  filter.SetTarget(Joints(0, 0.3, -0.05, 0, 0.3, 0), 10);
  for (int i = 0; i < 500; ++i) {
    filter.Follow(kLimits.dq_max);
    REQUIRE(Measure(kModel, filter.position()).self >= at_start - 1e-5);
  }
  filter.SetTarget(kHome, 10);
  for (int i = 0; i < 1500; ++i) filter.Follow(kLimits.dq_max);
  CHECK(filter.position() == kHome);

  JointVector q = kHome;
  q[4] = kLimits.q_max[4] + 0.02;
  filter.Reset(q);
  JointVector target = q;
  target[4] = kLimits.q_max[4] - 0.1;
  filter.SetTarget(target, 10);
  double last = q[4];
  for (int i = 0; i < 300; ++i) {
    filter.Follow(kLimits.dq_max);
    CHECK(filter.position()[4] <= last);
    last = filter.position()[4];
  }
  CHECK(filter.position() == target);
}

TEST_CASE("A declared stop breaks the jerk limit, not the acceleration limit, and goes on to rest") {
  for (const bool then_follow : {false, true}) {
    CommandFilter filter(kLimits, kModel);
    filter.Reset(kHome);
    JointVector target = kHome;
    target[5] += 1.5;
    target[0] += 0.3;
    filter.SetTarget(target, 10);
    for (int i = 0; i < 60; ++i) filter.Follow(kLimits.dq_max);
    const double speed = filter.velocity()[5];
    REQUIRE(speed > 1);
    filter.Halt();
    CHECK(filter.halted());
    CHECK(filter.velocity()[5] == Approx(speed - 20 * kDt));
    int ticks = 1;
    while (!filter.at_rest() && ticks < 200) {
      const JointVector before = filter.velocity();
      if (then_follow) {
        filter.SetTarget(kHome, 10);
        filter.Follow(kLimits.dq_max);
      } else {
        filter.Halt();
      }
      CHECK(Most(filter.velocity() - before) <= 20 * kDt + 1e-12);
      ++ticks;
    }
    CHECK(ticks == static_cast<int>(std::ceil(speed / (20 * kDt))));
    filter.Brake();
    CHECK_FALSE(filter.halted());
  }
}

TEST_CASE("The same targets give the same reference, bit for bit") {
  CommandFilter a(kLimits, kModel), b(kLimits, kModel);
  a.Reset(kHome);
  b.Reset(kHome);
  std::mt19937 random(9);
  for (int i = 0; i < 3000; ++i) {
    if (i % 10 == 0) {
      const JointVector target = NearHome(random);
      a.SetTarget(target, 10);
      b.SetTarget(target, 10);
    }
    a.Follow(kLimits.dq_max);
    b.Follow(kLimits.dq_max);
    REQUIRE(a.position() == b.position());
    REQUIRE(a.velocity() == b.velocity());
  }
}

TEST_CASE("A tick of the filter does not allocate") {
  if (!AllocationHookActive()) {
    WARN("skipped: sanitizers own the allocator");
    return;
  }
  REQUIRE(AllocationHookSeesAll());
  CommandFilter filter(kLimits, kModel);
  filter.Reset(kHome);
  std::mt19937 random(10);
  const AllocationCounter counter;
  for (int i = 0; i < 5000; ++i) {
    if (i % 10 == 0) filter.SetTarget(NearHome(random, 2), 10);
    filter.Follow(kLimits.dq_max);
    if (i % 500 == 499) filter.Halt();
  }
  const auto n = counter.count();
  CHECK(n == 0);
}

}  // namespace intabs
