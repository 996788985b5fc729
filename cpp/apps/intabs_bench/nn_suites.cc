// lstm: one tick of 8 x 128, input 32, in every weight format; 64 ticks at once; the memory limit.
// encoder: 100 steps through a bidirectional 8 x 128, with one thread and with two.
#include <pthread.h>
#include <sched.h>

#include <algorithm>
#include <cstdio>
#include <random>
#include <stdexcept>
#include <thread>

#include "intabs/nn/network.h"
#include "memory_readers.h"
#include "suite.h"

namespace intabs::bench {
namespace {

volatile float sink = 0;  // results go here, so that no work is optimised away

struct Format {
  WeightFormat format;
  const char* name;
  int bytes;  // a weight
};
constexpr Format kFormats[] = {
    {WeightFormat::kFp32, "fp32", 4}, {WeightFormat::k16, "16", 2}, {WeightFormat::k8, "8", 1}};

NetworkSpec Policy() {
  return {.input = 32, .layers = 8, .hidden = 128, .residual = true, .heads = {{"action", 7}}};
}

RowMatrixXf Inputs(int rows, int cols) {
  std::mt19937 rng(1);
  std::normal_distribution<float> normal;
  return RowMatrixXf::NullaryExpr(rows, cols, [&] { return normal(rng); });
}

void Must(Status s) {
  if (s != Status::kOk) throw std::runtime_error("a step failed");
}

// The tail: a long run on one CPU, at real-time priority where that is allowed, beside a loop that does
// nothing but watch the clock for the same number of equally long ticks.
void Soak(Report& report, Network& net, const RowMatrixXf& X, long steps) {
  cpu_set_t before, one;
  sched_getaffinity(0, sizeof before, &before);
  CPU_ZERO(&one);
  CPU_SET(sched_getcpu(), &one);
  sched_setaffinity(0, sizeof one, &one);
  const sched_param priority{.sched_priority = 80}, normal{.sched_priority = 0};
  const bool fifo = pthread_setschedparam(pthread_self(), SCHED_FIFO, &priority) == 0;
  const auto now = [] { return std::chrono::steady_clock::now(); };
  const auto us = [](auto d) { return std::chrono::duration<double, std::micro>(d).count(); };
  // Linux stops a SCHED_FIFO thread that takes more than 95 % of a CPU for 50 ms in every second.
  const auto rest = [](long i) {
    if (i % 200 == 199) std::this_thread::sleep_for(std::chrono::milliseconds(1));
  };

  Samples& busy = report.rows["soak_step_fp32"];
  busy.StartRound(static_cast<size_t>(steps));
  for (long i = 0; i < steps; ++i) {
    const auto start = now();
    Must(net.Step(X.row(i % X.rows()).data()));
    busy.Add(us(now() - start));
    rest(i);
  }
  const auto tick = std::chrono::duration<double, std::micro>(busy.Percentile(.5));
  Samples& empty = report.rows["soak_empty_loop"];
  empty.StartRound(static_cast<size_t>(steps));
  for (long i = 0; i < steps; ++i) {
    const auto start = now();
    auto end = start;
    while (end - start < tick) end = now();
    empty.Add(us(end - start));
    rest(i);
  }
  if (fifo) pthread_setschedparam(pthread_self(), SCHED_OTHER, &normal);
  sched_setaffinity(0, sizeof before, &before);
  report.ratios["soak_step_fp32: worst / median"] = busy.Percentile(1) / busy.Percentile(.5);
  report.ratios["soak_empty_loop: worst / median"] = empty.Percentile(1) / empty.Percentile(.5);
  report.notes.push_back(std::string("soak: pinned, ") +
                         (fifo ? "SCHED_FIFO 80" : "normal priority (SCHED_FIFO is not allowed)"));
}

}  // namespace

Report Lstm(const Options& options) {
  const WeightsFile weights = WeightsFile::Random(Policy(), 1);
  const RowMatrixXf X = Inputs(64, Policy().input);
  Report report;

  struct Path {
    std::string name;
    Network net;
    int samples;
  };
  std::vector<Path> paths;
  std::vector<NetworkBatch> batches;
  for (const Isa isa : kAllIsas) {
    if (!IsSupported(isa)) {
      report.notes.push_back(std::string("skipped: ") + Name(isa) + ", this CPU lacks it");
      continue;
    }
    for (const Format& f : kFormats) {
      const std::string name =
          std::string("step_") + f.name + (isa == BestIsa() ? "" : std::string(" ") + Name(isa));
      paths.push_back({name, Network(weights, "net", {.format = f.format, .isa = isa}),
                       isa == BestIsa() ? options.samples : options.samples / 5});
      if (isa == BestIsa()) batches.emplace_back(paths.back().net, 64);
    }
  }
  const char* batch_names[] = {"batch_64", "batch_64_16", "batch_64_8"};

  const auto readers = MemoryReaders();
  AlignedFloats memory;
  memory.resize(paths.front().net.weight_bytes() / sizeof(float) / 256 * 256);
  std::map<std::string, std::map<std::string, Samples>> by_reader;

  for (int round = 0; round < options.rounds; ++round) {
    for (const Format& f : kFormats) {
      for (const MemoryReader& r : readers) {
        const size_t floats = memory.size() * f.bytes / 4 / 256 * 256;
        Measure(by_reader[f.name][r.name], options.samples / 2,
                [&] { sink = sink + r.read(memory.data(), floats); });
      }
    }
    for (Path& p : paths) {
      int i = 0;
      Measure(report.rows[p.name], p.samples, [&] { Must(p.net.Step(X.row(i++ % X.rows()).data())); });
    }
    for (size_t k = 0; k < batches.size(); ++k) {
      Measure(report.rows[batch_names[k]], options.samples / 10, [&] { Must(batches[k].Step(X.data())); });
    }
  }

  for (const Format& f : kFormats) {
    const auto best = std::min_element(
        by_reader[f.name].begin(), by_reader[f.name].end(),
        [](const auto& a, const auto& b) { return a.second.BestMedian() < b.second.BestMedian(); });
    const std::string memory_row = std::string("memory_") + f.name, step_row = std::string("step_") + f.name;
    report.rows[memory_row] = best->second;
    report.rows[memory_row].bytes = memory.size() * f.bytes / 256 * 256;
    report.ratios[step_row + " / " + memory_row] =
        report.rows[step_row].BestMedian() / report.rows[memory_row].BestMedian();
    report.notes.push_back(memory_row + ": fastest reader is " + best->first);
  }
  const double singles = 64 * report.rows["step_fp32"].BestMedian();
  for (const char* name : batch_names) {
    report.ratios[std::string(name) + " / 64 step_fp32"] = report.rows[name].BestMedian() / singles;
  }
  for (const Path& p : paths) report.rows[p.name].bytes = p.net.weight_bytes();
  report.notes.push_back(std::string("rows without a name behind them: ") + Name(BestIsa()));
  if (options.soak > 0) Soak(report, paths[paths.size() - std::size(kFormats)].net, X, options.soak);
  return report;
}

Report Encoder(const Options& options) {
  NetworkSpec spec = Policy();
  spec.bidirectional = true;
  const WeightsFile weights = WeightsFile::Random(spec, 1);
  const RowMatrixXf X = Inputs(100, spec.input);
  Report report;
  std::vector<RowMatrixXf> heads;
  std::vector<Network> nets;
  for (const Format& f : kFormats) nets.emplace_back(weights, "net", NetworkOptions{.format = f.format});
  for (int round = 0; round < options.rounds; ++round) {
    for (size_t k = 0; k < nets.size(); ++k) {
      for (const int threads : {1, 2}) {
        const std::string name = std::string("sequence_100_bi") + (threads == 2 ? "_2t" : "") +
                                 (k > 0 ? std::string(" ") + kFormats[k].name + " bit" : "");
        Measure(report.rows[name], std::max(options.samples / 20, 5),
                [&] { nets[k].Sequence(X, heads, threads); });
      }
    }
  }
  report.ratios["sequence_100_bi_2t / sequence_100_bi"] =
      report.rows["sequence_100_bi_2t"].BestMedian() / report.rows["sequence_100_bi"].BestMedian();
  return report;
}

}  // namespace intabs::bench
