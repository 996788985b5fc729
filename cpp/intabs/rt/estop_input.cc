#include "intabs/rt/estop_input.h"

#include <poll.h>
#include <signal.h>
#include <unistd.h>

#include <atomic>

namespace intabs {
namespace {
std::atomic<bool> estop_signalled{false};
static_assert(std::atomic<bool>::is_always_lock_free);
}  // namespace

void InstallEstopSignal() noexcept {
  struct sigaction action {};
  action.sa_handler = [](int) { estop_signalled = true; };
  sigaction(SIGUSR1, &action, nullptr);
}

bool TakeEstopSignal() noexcept {
  return estop_signalled.load(std::memory_order_relaxed) && estop_signalled.exchange(false);
}

Keys::Keys() noexcept {
  // A program in the background would be stopped by SIGTTOU.
  if (isatty(STDIN_FILENO) == 0 || tcgetpgrp(STDIN_FILENO) != getpgrp()) return;
  if (tcgetattr(STDIN_FILENO, &before_) != 0) return;
  termios raw = before_;
  raw.c_lflag &= ~static_cast<tcflag_t>(ICANON | ECHO);
  raw.c_cc[VMIN] = 0;
  raw.c_cc[VTIME] = 0;
  active_ = tcsetattr(STDIN_FILENO, TCSANOW, &raw) == 0;
}

Keys::~Keys() {
  if (active_) tcsetattr(STDIN_FILENO, TCSANOW, &before_);
}

char Keys::Take() noexcept {
  if (!active_) return 0;
  pollfd input{STDIN_FILENO, POLLIN, 0};
  char key = 0;
  if (poll(&input, 1, 0) <= 0 || read(STDIN_FILENO, &key, 1) != 1) return 0;
  return key;
}

}  // namespace intabs
