#include "intabs/rt/periodic.h"

#include <time.h>

#include <cerrno>

namespace intabs {

int64_t MonotonicUs() noexcept {
  timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return t.tv_sec * int64_t{1000000} + t.tv_nsec / 1000;
}

PeriodicTimer::PeriodicTimer(int64_t period_us) noexcept : period_us_(period_us), due_us_(MonotonicUs()) {}

Wakeup PeriodicTimer::Wait() noexcept {
  due_us_ += period_us_;
  const int64_t late_us = MonotonicUs() - due_us_;
  const int64_t missed = late_us > 0 ? late_us / period_us_ : 0;
  due_us_ += missed * period_us_;
  const timespec due{due_us_ / 1000000, (due_us_ % 1000000) * 1000};
  while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, nullptr) == EINTR) {
  }
  const int64_t now_us = MonotonicUs();
  return {now_us, now_us - due_us_, missed};
}

}  // namespace intabs
