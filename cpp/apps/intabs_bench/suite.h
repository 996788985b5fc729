// What every suite of intabs_bench shares: samples, their statistics, the report.
//
// To add a suite: one function in a file of its own, one line in the table of main.cc.
#pragma once

#include <chrono>
#include <functional>
#include <map>
#include <string>
#include <vector>

namespace intabs::bench {

struct Options {
  int rounds = 5;     // each round measures every row, so that a ratio compares neighbours in time
  int samples = 500;  // of a quick row in one round; slow rows take fewer
  std::string models = "models";  // folder; plant
  long soak = 0;      // steps of the long run for the tail; 0: none
};

// Microseconds, one entry a sample, one list a round.
class Samples {
 public:
  void StartRound(size_t samples) {
    rounds_.emplace_back();
    rounds_.back().reserve(samples);
  }
  void Add(double us) { rounds_.back().push_back(us); }
  // Over all rounds. p in [0, 1].
  double Percentile(double p) const;
  double BestMedian() const;  // smallest of the rounds' medians: least disturbed by other programs
  size_t n() const;
  size_t bytes = 0;  // of memory that one sample reads; 0: not stated

 private:
  std::vector<std::vector<double>> rounds_;
};

struct Report {
  std::map<std::string, Samples> rows;
  std::map<std::string, double> ratios;  // of the best medians
  std::vector<std::string> notes;        // such as paths that this CPU lacks
};

// Calls f `samples` times (and a few times before, unmeasured) and adds the times to `row` as one round.
template <typename F>
void Measure(Samples& row, int samples, F&& f) {
  for (int i = 0; i < samples / 20 + 1; ++i) f();
  row.StartRound(samples);
  for (int i = 0; i < samples; ++i) {
    const auto start = std::chrono::steady_clock::now();
    f();
    row.Add(std::chrono::duration<double, std::micro>(std::chrono::steady_clock::now() - start).count());
  }
}

// The suites.
Report Lstm(const Options& options);
Report Encoder(const Options& options);
Report Tags(const Options& options);
Report Filter(const Options& options);
Report Loop(const Options& options);
Report Plant(const Options& options);

std::string MachineName();  // the CPU's model and what is supported
void Print(const Report& report);
void WriteJson(const Report& report, const std::string& suite, const std::string& path);  // throws

}  // namespace intabs::bench
