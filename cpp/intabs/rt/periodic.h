// A loop at a fixed rate on the host's monotonic clock.
//
//   PeriodicTimer timer(kDriverPeriodUs);
//   while (!StopRequested()) {
//     const Wakeup w = timer.Wait();
//     ...
//   }
#pragma once

#include <cstdint>

namespace intabs {

// Microseconds of CLOCK_MONOTONIC. Real-time safe.
int64_t MonotonicUs() noexcept;

struct Wakeup {
  int64_t now_us;      // when the loop woke up
  int64_t latency_us;  // how long after the time it was due
  int64_t missed;      // periods that went by unused since the last wake-up
};

// Real-time safe. Ticks are due at start + k * period: one late tick does not shift the others, and ticks
// that were missed altogether are skipped, not caught up with.
class PeriodicTimer {
 public:
  explicit PeriodicTimer(int64_t period_us) noexcept;

  // Sleeps until the next tick is due, also through signals.
  Wakeup Wait() noexcept;

 private:
  int64_t period_us_;
  int64_t due_us_;
};

}  // namespace intabs
