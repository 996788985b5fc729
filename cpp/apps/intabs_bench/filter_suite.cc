// How long a tick of the command filter takes, with capsules, table and all.
#include <random>

#include "intabs/control/arm_controller.h"
#include "suite.h"

namespace intabs::bench {
namespace {

using Clock = std::chrono::steady_clock;

JointVector Home() {
  JointVector q;
  q << 0, 0.2, 1.0, 0, 0.8, 0;
  return q;
}

// One round: `ticks` driver ticks, each timed alone. `next` gives the target of each 25 Hz command.
template <typename Next>
void MeasureTicks(Samples& row, int ticks, Next&& next) {
  ArmController controller(ArmLimits{}, ArmModel::Lite6(), {.align_within = 100});
  int64_t now_us = 0;
  controller.Reset(Home(), now_us);
  ArmCommand c;
  c.session = 1;
  c.mode = ArmMode::kServo;
  row.StartRound(ticks);
  for (int tick = 0; tick < ticks; ++tick) {
    now_us += kDriverPeriodUs;
    if (tick % 10 == 0) {
      ++c.seq;
      c.q_target = next(tick * 1e-6 * kDriverPeriodUs);
      (void)controller.Accept(c, now_us);
    }
    const auto start = Clock::now();
    controller.Tick(now_us);
    row.Add(std::chrono::duration<double, std::micro>(Clock::now() - start).count());
  }
}

}  // namespace

Report Filter(const Options& options) {
  Report report;
  const int ticks = 20 * options.samples;
  std::mt19937 random(1);
  std::uniform_real_distribution<double> u(-1, 1);
  const ArmModel arm = ArmModel::Lite6();
  for (int round = 0; round < options.rounds; ++round) {
    // A policy's smooth motion; then a jump with every command, mostly into table or arm.
    MeasureTicks(report.rows["tick_smooth"], ticks, [](double t) {
      JointVector q = Home();
      for (int i = 0; i < kNumJoints; ++i) q[i] += 0.3 * std::sin((1 + 0.2 * i) * t + i) - 0.3 * std::sin(i);
      return q;
    });
    MeasureTicks(report.rows["tick_jumps"], ticks, [&](double) {
      return JointVector(JointVector::NullaryExpr([&](Eigen::Index i) {
        return arm.q_min()[i] + 0.5 * (1 + u(random)) * (arm.q_max()[i] - arm.q_min()[i]);
      }));
    });
  }
  report.notes.push_back(
      "a tick: watchdogs, path, six joints, and up to two looks at the whole stop (16 instants, 28 pairs of "
      "capsules, 13 bodies above the table)");
  return report;
}

}  // namespace intabs::bench
