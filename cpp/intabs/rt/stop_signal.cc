#include "intabs/rt/stop_signal.h"

#include <signal.h>

#include <atomic>

namespace intabs {
namespace {
std::atomic<bool> stop_requested{false};
static_assert(std::atomic<bool>::is_always_lock_free);
}  // namespace

void InstallStopSignals() noexcept {
  struct sigaction action {};
  action.sa_handler = [](int) { stop_requested = true; };
  sigaction(SIGINT, &action, nullptr);
  sigaction(SIGTERM, &action, nullptr);
}

bool StopRequested() noexcept { return stop_requested; }

}  // namespace intabs
