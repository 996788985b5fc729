// plant: a driver tick (4 ms) of each task's world while the arm swings, without pictures.
#include <cmath>

#include "intabs/plant/task.h"
#include "intabs/plant/world.h"
#include "suite.h"

namespace intabs::bench {

Report Plant(const Options& options) {
  Report report;
  std::vector<std::unique_ptr<World>> worlds;
  for (const std::string& name : TaskNames()) worlds.push_back(std::make_unique<World>(options.models, name));
  for (int round = 0; round < options.rounds; ++round) {
    for (size_t k = 0; k < worlds.size(); ++k) {
      World& world = *worlds[k];
      const std::string& name = TaskNames()[k];
      world.Reset(round, 5);
      Measure(report.rows["tick " + name], options.samples, [&] {
        const double t = 1e-6 * static_cast<double>(world.time_us());
        ServoTarget target;
        for (int j = 0; j < kNumJoints; ++j) {
          const double amplitude = 0.2, w = 1 + 0.3 * j;
          target.q[j] = World::Home()[j] + amplitude * (1 - std::cos(w * t));
          target.dq[j] = amplitude * w * std::sin(w * t);
        }
        world.Step(target);
      });
      Measure(report.rows["reset " + name], std::max(options.samples / 100, 2), [&] { world.Reset(round, 5); });
    }
  }
  for (const std::string& name : TaskNames()) {
    report.ratios[name + ": x real time"] =
        static_cast<double>(kDriverPeriodUs) / report.rows["tick " + name].BestMedian();
  }
  report.notes.emplace_back(
      "the beads lie still here; world_tasks_test prints what whole pours and stirs take, scripts included");
  return report;
}

}  // namespace intabs::bench
