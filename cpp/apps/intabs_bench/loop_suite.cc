// How late a 250 Hz loop wakes up, beside cyclictest where that is installed (Debian: rt-tests).
#include <algorithm>
#include <array>
#include <cstdio>
#include <cstdlib>
#include <stdexcept>
#include <thread>

#include "intabs/rt/periodic.h"
#include "intabs/rt/realtime.h"
#include "suite.h"

namespace intabs::bench {
namespace {

constexpr int kPriority = 80;
constexpr int64_t kPeriodUs = 4000;

double Percentile(std::vector<double> values, double p) {
  if (values.empty()) return 0;
  std::sort(values.begin(), values.end());
  return values[std::min(values.size() - 1, static_cast<size_t>(p * static_cast<double>(values.size())))];
}

// One round in a thread of its own, which takes its rights with it.
std::vector<double> Ours(int ticks, bool realtime, std::vector<std::string>& faults) {
  std::vector<double> latencies;
  latencies.reserve(ticks);
  std::thread([&] {
    if (realtime) faults = EnterRealtime(kPriority).faults;
    PeriodicTimer timer(kPeriodUs);
    for (int i = 0; i < ticks; ++i) latencies.push_back(static_cast<double>(timer.Wait().latency_us));
  }).join();
  return latencies;
}

// The same with cyclictest, from its histogram of microseconds; empty if it is not there or fails.
std::vector<double> Cyclictest(int ticks, bool realtime) {
  const std::string command =
      "cyclictest -q -t1 -h20000 -i" + std::to_string(kPeriodUs) + " -l" + std::to_string(ticks) +
      (realtime ? " -m -p" + std::to_string(kPriority) : " --policy=other") + " 2>/dev/null";
  std::FILE* pipe = popen(command.c_str(), "r");
  if (pipe == nullptr) return {};
  std::vector<double> latencies;
  std::array<char, 256> line;
  while (std::fgets(line.data(), line.size(), pipe) != nullptr) {
    int us = 0, count = 0;
    if (line[0] == '#' || std::sscanf(line.data(), "%d %d", &us, &count) != 2) continue;
    latencies.insert(latencies.end(), count, us);
  }
  if (pclose(pipe) != 0) latencies.clear();
  return latencies;
}

double Median(std::vector<double> values) { return Percentile(std::move(values), 0.5); }

}  // namespace

Report Loop(const Options& options) {
  Report report;
  const bool have_cyclictest = std::system("command -v cyclictest >/dev/null 2>&1") == 0;
  std::vector<std::string> faults;
  std::vector<double> p99_ratios, p99_ratios_normal;
  const auto add = [&report](const char* row, const std::vector<double>& latencies) {
    if (latencies.empty()) return;
    report.rows[row].StartRound(latencies.size());
    for (const double us : latencies) report.rows[row].Add(us);
  };
  for (int round = 0; round < options.rounds; ++round) {
    std::fprintf(stderr, "loop: round %d of %d, %.0f s\n", round + 1, options.rounds,
                 1e-6 * static_cast<double>(kPeriodUs) * options.samples * (have_cyclictest ? 4 : 2));
    for (const bool realtime : {true, false}) {
      std::vector<std::string> refused;
      const std::vector<double> ours = Ours(options.samples, realtime, refused);
      if (realtime) faults = refused;
      add(realtime ? "wakeup" : "wakeup_normal_priority", ours);
      if (!have_cyclictest) continue;
      const std::vector<double> theirs = Cyclictest(options.samples, realtime);
      add(realtime ? "cyclictest" : "cyclictest_normal_priority", theirs);
      if (theirs.empty()) continue;
      (realtime ? p99_ratios : p99_ratios_normal)
          .push_back(Percentile(ours, .99) / std::max(1.0, Percentile(theirs, .99)));
    }
  }
  if (!p99_ratios.empty()) report.ratios["wakeup_p99 / cyclictest"] = Median(p99_ratios);
  if (!p99_ratios_normal.empty())
    report.ratios["wakeup_normal_priority_p99 / cyclictest"] = Median(p99_ratios_normal);
  for (const std::string& fault : faults) report.notes.push_back("without real-time rights: " + fault);
  report.notes.push_back(have_cyclictest
                             ? "ratios: median of paired rounds, ours and cyclictest by turns"
                             : "cyclictest is not installed: apt-get install rt-tests to compare");
  return report;
}

}  // namespace intabs::bench
