#include "suite.h"

#include <algorithm>
#include <cstdio>
#include <fstream>
#include <nlohmann/json.hpp>
#include <stdexcept>

namespace intabs::bench {

double Samples::Percentile(double p) const {
  std::vector<double> all;
  for (const auto& round : rounds_) all.insert(all.end(), round.begin(), round.end());
  if (all.empty()) return 0;
  const size_t k = std::min(all.size() - 1, static_cast<size_t>(p * static_cast<double>(all.size())));
  std::nth_element(all.begin(), all.begin() + static_cast<ptrdiff_t>(k), all.end());
  return all[k];
}

double Samples::BestMedian() const {
  double best = 0;
  for (auto round : rounds_) {
    std::nth_element(round.begin(), round.begin() + static_cast<ptrdiff_t>(round.size() / 2), round.end());
    const double median = round[round.size() / 2];
    if (best == 0 || median < best) best = median;
  }
  return best;
}

size_t Samples::n() const {
  size_t n = 0;
  for (const auto& round : rounds_) n += round.size();
  return n;
}

std::string MachineName() {
  std::ifstream cpuinfo("/proc/cpuinfo");
  for (std::string line; std::getline(cpuinfo, line);) {
    if (line.starts_with("model name")) return line.substr(line.find(':') + 2);
  }
  return "unknown CPU";
}

void Print(const Report& report) {
  std::printf("%-32s %10s %10s %10s %10s %10s %8s\n", "microseconds", "best p50", "p50", "p99", "p99.9",
              "max", "n");
  for (const auto& [name, s] : report.rows) {
    std::printf("%-32s %10.2f %10.2f %10.2f %10.2f %10.2f %8zu %9zu\n", name.c_str(), s.BestMedian(),
                s.Percentile(.5), s.Percentile(.99), s.Percentile(.999), s.Percentile(1), s.n(), s.bytes);
  }
  for (const auto& [name, r] : report.ratios) std::printf("ratio %-40s %6.3f\n", name.c_str(), r);
  for (const std::string& note : report.notes) std::printf("%s\n", note.c_str());
}

void WriteJson(const Report& report, const std::string& suite, const std::string& path) {
  nlohmann::json out = {{"suite", suite},
                        {"machine", MachineName()},
                        {"rows", nlohmann::json::object()},
                        {"ratios", report.ratios},
                        {"notes", report.notes}};
  for (const auto& [name, s] : report.rows) {
    auto& row = out["rows"][name];
    row = {{"p50_us", s.Percentile(.5)}, {"p99_us", s.Percentile(.99)},   {"p999_us", s.Percentile(.999)},
           {"max_us", s.Percentile(1)},  {"best_p50_us", s.BestMedian()}, {"n", s.n()}};
    if (s.bytes > 0) row["bytes"] = s.bytes;
  }
  std::ofstream file(path);
  file << out.dump(2) << "\n";
  if (!file.flush()) throw std::runtime_error("cannot write " + path);
}

}  // namespace intabs::bench
