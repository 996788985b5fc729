// ESTOP by signal and by key. The driver's loop turns it into its latched stop, like one that comes as a
// message.
#pragma once

#include <termios.h>

namespace intabs {

// From now on SIGUSR1 (`kill -USR1 <pid>`) asks for a stop.
void InstallEstopSignal() noexcept;

// Whether SIGUSR1 has come since the last call. Real-time safe.
bool TakeEstopSignal() noexcept;

// Keys of the terminal this program was started on, one at a time and without Enter. Ctrl-C stays a signal.
// The terminal gets its old mode back at the end. Where standard input is no terminal, or the program runs in
// the background, no key ever comes.
class Keys {
 public:
  Keys() noexcept;
  ~Keys();
  Keys(const Keys&) = delete;
  Keys& operator=(const Keys&) = delete;

  bool active() const noexcept { return active_; }
  // The oldest key pressed, 0 if none. Never waits, but is a system call: not for the tick.
  char Take() noexcept;

 private:
  bool active_ = false;
  termios before_{};
};

}  // namespace intabs
