#include "intabs/rt/realtime.h"

#include <sched.h>
#include <sys/mman.h>

#include <cerrno>
#include <cstring>

namespace intabs {
namespace {

// Pages that are touched once, locked, never fault again.
__attribute__((noinline)) void TouchStack() {
  constexpr size_t kBytes = 256 * 1024;
  volatile unsigned char room[kBytes];
  for (size_t i = 0; i < kBytes; i += 4096) room[i] = 0;
  (void)room[0];
}

}  // namespace

RealtimeResult EnterRealtime(int priority, int cpu) {
  RealtimeResult result;
  sched_param parameters{};
  parameters.sched_priority = priority;
  // 0: the calling thread alone.
  result.scheduled = sched_setscheduler(0, SCHED_FIFO, &parameters) == 0;
  if (!result.scheduled) {
    result.faults.push_back("SCHED_FIFO " + std::to_string(priority) + " refused (" + std::strerror(errno) +
                            "): run as root, or allow rtprio in /etc/security/limits.d and log in anew");
  }
  result.locked = mlockall(MCL_CURRENT | MCL_FUTURE) == 0;
  if (result.locked) {
    TouchStack();
  } else {
    result.faults.push_back(std::string("mlockall refused (") + std::strerror(errno) +
                            "): run as root, or allow memlock in /etc/security/limits.d and log in anew");
  }
  if (cpu >= 0) {
    cpu_set_t set;
    CPU_ZERO(&set);
    if (cpu < CPU_SETSIZE) CPU_SET(cpu, &set);
    result.pinned = sched_setaffinity(0, sizeof set, &set) == 0;
    if (!result.pinned) {
      result.faults.push_back("CPU " + std::to_string(cpu) + " refused (" + std::strerror(errno) +
                              "): choose one that exists and that this process may use");
    }
  }
  return result;
}

}  // namespace intabs
