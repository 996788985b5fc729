#include <pty.h>
#include <sched.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <catch2/catch.hpp>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <random>
#include <thread>
#include <vector>

#include "common/alloc_hook.h"
#include "intabs/rt/estop_input.h"
#include "intabs/rt/flight_recorder.h"
#include "intabs/rt/latest.h"
#include "intabs/rt/periodic.h"
#include "intabs/rt/realtime.h"
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

namespace {

struct Row {
  int64_t n;
};
int FormatRow(const Row& row, char* out, size_t size) {
  return std::snprintf(out, size, "%lld", static_cast<long long>(row.n));
}

// A folder that is gone afterwards.
struct Folder {
  Folder() {
    char name[] = "/tmp/intabs_flight_XXXXXX";
    path = mkdtemp(name);
  }
  ~Folder() { std::filesystem::remove_all(path); }
  // Name and rows of each file, without the header; the earliest rows first.
  std::vector<std::pair<std::string, std::vector<int64_t>>> Files() const {
    std::vector<std::pair<std::string, std::vector<int64_t>>> files;
    for (const auto& entry : std::filesystem::directory_iterator(path)) {
      std::ifstream in(entry.path());
      std::string line;
      std::getline(in, line);
      CHECK(line == "n");
      files.emplace_back(entry.path().filename(), std::vector<int64_t>());
      while (std::getline(in, line)) files.back().second.push_back(std::stoll(line));
    }
    std::sort(files.begin(), files.end(), [](const auto& a, const auto& b) { return a.second < b.second; });
    return files;
  }
  std::string path;
};

bool Contains(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

// Runs `child` in a process of its own; its exit code.
template <class F>
int InChild(F&& child) {
  const pid_t pid = fork();
  if (pid == 0) _exit(child());
  int status = 0;
  waitpid(pid, &status, 0);
  return WIFEXITED(status) ? WEXITSTATUS(status) : -1;
}

}  // namespace

TEST_CASE("The flight recorder writes the last rows before a trigger and those shortly after it, in order") {
  Folder folder;
  {
    FlightRecorder<Row> recorder(folder.path, "n", &FormatRow, 100, 20);
    int64_t n = 0;
    for (int i = 0; i < 1234; ++i) recorder.Record({n++});
    recorder.Trigger("fault");
    for (int i = 0; i < 5; ++i) recorder.Record({n++});
    recorder.Trigger("another");  // one is under way
    for (int i = 0; i < 500; ++i) recorder.Record({n++});
    while (recorder.written() + recorder.lost() < 1)
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
    recorder.Trigger("estop");
    for (int i = 0; i < 7; ++i) recorder.Record({n++});
  }  // ends before the second one is complete
  const auto files = folder.Files();
  REQUIRE(files.size() == 2);
  CHECK(Contains(files[0].first, "fault"));
  REQUIRE(files[0].second.size() == 120);
  CHECK(files[0].second.front() == 1134);
  CHECK(files[0].second.back() == 1253);
  CHECK(std::is_sorted(files[0].second.begin(), files[0].second.end()));
  CHECK(Contains(files[1].first, "estop"));
  CHECK(files[1].second.back() == 1745);
  CHECK(files[1].second.front() == 1746 - 120);
}

TEST_CASE("A flight recorder that has not filled its ring writes what there is; without a trigger nothing") {
  Folder folder;
  {
    FlightRecorder<Row> quiet(folder.path, "n", &FormatRow, 100, 20);
    quiet.Record({1});
  }
  CHECK(folder.Files().empty());
  {
    FlightRecorder<Row> recorder(folder.path, "n", &FormatRow, 100, 2);
    for (int64_t n = 0; n < 3; ++n) recorder.Record({n});
    recorder.Trigger("fault");
    for (int64_t n = 3; n < 5; ++n) recorder.Record({n});
  }
  REQUIRE(folder.Files().size() == 1);
  CHECK(folder.Files()[0].second == std::vector<int64_t>{0, 1, 2, 3, 4});
}

TEST_CASE("A flight recorder that cannot write says so and lets the loop go on") {
  FlightRecorder<Row> recorder("/dev/null/nowhere", "n", &FormatRow, 10, 1);
  recorder.Trigger("fault");
  recorder.Record({1});
  while (recorder.written() + recorder.lost() < 1) std::this_thread::sleep_for(std::chrono::milliseconds(1));
  CHECK(recorder.lost() == 1);
  recorder.Record({2});
}

TEST_CASE("Recording and triggering do not allocate") {
  if (!AllocationHookActive()) {
    WARN("skipped: sanitizers own the allocator");
    return;
  }
  REQUIRE(AllocationHookSeesAll());
  Folder folder;
  FlightRecorder<Row> recorder(folder.path, "n", &FormatRow, 100, 10);
  const AllocationCounter counter;
  for (int64_t n = 0; n < 1000; ++n) {
    recorder.Record({n});
    if (n % 50 == 49) recorder.Trigger("fault");
  }
  const auto n = counter.count();
  CHECK(n == 0);
}

TEST_CASE("Real-time rights are taken where they are given, and each refusal is named with its cure") {
  // In processes of their own: locked memory and scheduling stay.
  const int as_is = InChild([] {
    const RealtimeResult r = EnterRealtime(10, 0);
    const bool fifo = sched_getscheduler(0) == SCHED_FIFO;
    return r.scheduled == fifo && r.ok() == (r.scheduled && r.locked && r.pinned) ? 0 : 1;
  });
  CHECK(as_is == 0);
  const int without_rights = InChild([] {
    if (getuid() != 0 || setgid(65534) != 0 || setuid(65534) != 0) return 0;  // has none anyway
    const RealtimeResult r = EnterRealtime(10, 100000);
    std::string all;
    for (const std::string& line : r.faults) all += line + "\n";
    const bool named = Contains(all, "SCHED_FIFO") && Contains(all, "rtprio") && Contains(all, "CPU 100000");
    return !r.ok() && !r.scheduled && named && sched_getscheduler(0) == SCHED_OTHER ? 0 : 1;
  });
  CHECK(without_rights == 0);
}

TEST_CASE("SIGUSR1 asks for a stop once") {
  InstallEstopSignal();
  CHECK_FALSE(TakeEstopSignal());
  raise(SIGUSR1);
  CHECK(TakeEstopSignal());
  CHECK_FALSE(TakeEstopSignal());
}

TEST_CASE("Keys come one by one from a terminal, none from a file, and the terminal gets its mode back") {
  CHECK(InChild([] {
          if (std::freopen("/dev/null", "r", stdin) == nullptr) return 2;
          Keys keys;
          return !keys.active() && keys.Take() == 0 ? 0 : 1;
        }) == 0);
  int terminal = -1;
  const pid_t pid = forkpty(&terminal, nullptr, nullptr, nullptr);
  if (pid == 0) {
    termios before{}, during{}, after{};
    tcgetattr(STDIN_FILENO, &before);
    bool right = true;
    {
      Keys keys;
      right = keys.active();
      tcgetattr(STDIN_FILENO, &during);
      std::string typed;
      for (int i = 0; i < 5000 && typed.size() < 2; ++i) {
        if (const char key = keys.Take()) typed += key;
        usleep(1000);
      }
      right &= typed == "r ";
    }
    tcgetattr(STDIN_FILENO, &after);
    right &= (during.c_lflag & ICANON) == 0 && after.c_lflag == before.c_lflag;
    _exit(right ? 0 : 1);
  }
  REQUIRE(write(terminal, "r ", 2) == 2);  // no Enter
  int status = 0;
  waitpid(pid, &status, 0);
  CHECK(WIFEXITED(status));
  CHECK(WEXITSTATUS(status) == 0);
  close(terminal);
}

TEST_CASE("SIGTERM raises the flag and nothing else") {
  InstallStopSignals();
  CHECK_FALSE(StopRequested());
  raise(SIGTERM);
  CHECK(StopRequested());
}

}  // namespace intabs
