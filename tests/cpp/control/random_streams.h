// Random streams of commands into an ArmController, and a judge of what comes out. A stream is made from its
// number alone, so that a failing one can be run again by itself.
#pragma once

#include <cstdint>
#include <string>

namespace intabs {

struct StreamFigures {
  int64_t streams = 0, ticks = 0;
  int64_t blocked_ticks = 0, halts = 0;  // ticks held back by the guard; declared stops from motion
  double max_position = -1e9, max_speed = 0, max_acceleration = 0,
         max_jerk = 0;                                    // beyond limit; of any joint
  double max_tcp = 0;                                     // [m/s]
  double min_self = 1e9, min_table = 1e9, min_box = 1e9;  // [m]
};

// Runs stream number `number`; adds to `figures`. Returns an empty text, or what was violated, where, and by
// which input.
std::string RunStream(uint64_t number, StreamFigures& figures);

}  // namespace intabs
