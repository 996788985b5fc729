// Real-time rights of a loop's thread. Set-up: not real-time safe.
#pragma once

#include <string>
#include <vector>

namespace intabs {

struct RealtimeResult {
  bool scheduled = false;  // SCHED_FIFO
  bool locked = false;     // no page of the process can be swapped out
  bool pinned = true;      // to the CPU asked for; true if none was
  // What was refused: one line each, what, why, and what to do.
  std::vector<std::string> faults;
  bool ok() const { return faults.empty(); }
};

// Gives the calling thread SCHED_FIFO at `priority` (1 .. 99), locks the process' memory, now and to come,
// touches the stack a loop may need, and pins the thread to `cpu` (-1: to none). What is refused changes
// nothing. Threads started afterwards inherit priority and CPU: start helpers before.
RealtimeResult EnterRealtime(int priority = 80, int cpu = -1);

}  // namespace intabs
