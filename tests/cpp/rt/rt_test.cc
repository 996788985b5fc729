#include <signal.h>

#include <algorithm>
#include <catch2/catch.hpp>
#include <cmath>
#include <random>
#include <thread>
#include <vector>

#include "common/alloc_hook.h"
#include "intabs/rt/latest.h"
#include "intabs/rt/periodic.h"
#include "intabs/rt/stop_signal.h"
#include "intabs/rt/tick_stats.h"

namespace intabs {

TEST_CASE("Ticks stay on the grid they started on, and missed ones are skipped and counted") {
  constexpr int64_t kPeriod = 10000;
  PeriodicTimer timer(kPeriod);
  const Wakeup first = timer.Wait();
  const int64_t grid = first.now_us - first.latency_us;
  int64_t last_due = grid;
  for (int i = 0; i < 8; ++i) {
    if (i == 3) std::this_thread::sleep_for(std::chrono::microseconds(35000));  // three ticks and a half
    const Wakeup w = timer.Wait();
    const int64_t due = w.now_us - w.latency_us;
    CHECK(w.latency_us >= 0);
    CHECK((due - grid) % kPeriod == 0);
    CHECK(due - last_due == (1 + w.missed) * kPeriod);
    if (i == 3) CHECK(w.missed >= 2);
    last_due = due;
  }
}

TEST_CASE("Percentiles of the tick statistics hold against sorting") {
  std::mt19937 random(5);
  std::lognormal_distribution<double> durations(3, 2);
  TickStats stats;
  CHECK(stats.PercentileUs(0.5) == 0);
  std::vector<double> all;
  for (int i = 0; i < 20000; ++i) {
    const double us = durations(random);
    all.push_back(us);
    stats.Add(us);
  }
  std::sort(all.begin(), all.end());
  for (const double p : {0.001, 0.01, 0.5, 0.9, 0.99, 0.999, 1.0}) {
    const double exact = all[static_cast<size_t>(std::ceil(p * static_cast<double>(all.size()))) - 1];
    INFO("p " << p << " exact " << exact);
    CHECK(stats.PercentileUs(p) >= exact - 1e-9);
    CHECK(stats.PercentileUs(p) <= exact * 1.032 + 0.1);
  }
  CHECK(stats.max_us() == all.back());
  CHECK(stats.count() == 20000);
}

TEST_CASE("The tick statistics take any number") {
  TickStats stats;
  for (const double us : {0.0, -1.0, 1e300, std::nan(""), double(INFINITY)}) stats.Add(us);
  CHECK(stats.count() == 5);
  CHECK(stats.PercentileUs(0.5) <= 0.1);
  stats.Clear();
  CHECK(stats.count() == 0);
}

TEST_CASE("The reader of the latest-value slot gets whole values, in order, and the last one") {
  struct Value {
    int64_t a = 0;
    std::vector<int64_t> copies = std::vector<int64_t>(64, 0);
  };
  Latest<Value> latest;
  CHECK(latest.Take() == nullptr);
  constexpr int64_t kLast = 200000;
  std::thread writer([&] {
    for (int64_t k = 1; k <= kLast; ++k) {
      Value& v = latest.write_slot();
      v.a = k;
      std::fill(v.copies.begin(), v.copies.end(), k);
      latest.Publish();
    }
  });
  int64_t newest = 0, torn = 0, disordered = 0;
  while (newest < kLast) {
    const Value* v = latest.Take();
    if (v == nullptr) {
      std::this_thread::yield();
      continue;
    }
    disordered += v->a <= newest;
    newest = v->a;
    torn += std::count(v->copies.begin(), v->copies.end(), newest) != 64;
  }
  writer.join();
  CHECK(torn == 0);
  CHECK(disordered == 0);
  CHECK(latest.Take() == nullptr);
}

TEST_CASE("What the reader holds does not change while the writer goes on") {
  Latest<int> latest;
  const auto write = [&](int v) {
    latest.write_slot() = v;
    latest.Publish();
  };
  write(1);
  const int* held = latest.Take();
  for (int v = 2; v <= 5; ++v) {
    write(v);
    CHECK(*held == 1);
  }
  held = latest.Take();
  REQUIRE(held != nullptr);
  CHECK(*held == 5);
}

TEST_CASE("Timer, statistics and slot do not allocate") {
  if (!AllocationHookActive()) {
    WARN("skipped: sanitizers own the allocator");
    return;
  }
  REQUIRE(AllocationHookSeesAll());
  PeriodicTimer timer(100);
  TickStats stats;
  Latest<double> latest;
  const AllocationCounter counter;
  for (int i = 0; i < 100; ++i) {
    stats.Add(static_cast<double>(timer.Wait().latency_us));
    latest.write_slot() = stats.PercentileUs(0.99);
    latest.Publish();
    (void)latest.Take();
  }
  const auto n = counter.count();
  CHECK(n == 0);
}

TEST_CASE("SIGTERM raises the flag and nothing else") {
  InstallStopSignals();
  CHECK_FALSE(StopRequested());
  raise(SIGTERM);
  CHECK(StopRequested());
}

}  // namespace intabs
