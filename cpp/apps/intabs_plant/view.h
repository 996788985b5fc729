// Everything that makes pictures of the plant: camera frames for perception, video, strip, window.
#pragma once

#include <atomic>
#include <cstdint>
#include <exception>
#include <memory>
#include <thread>

#include "intabs/plant/world.h"
#include "intabs/rt/latest.h"
#include "intabs_plant/options.h"

namespace intabs {

class Painter;

// In lockstep Look() draws before it returns. By the wall clock it leaves a snapshot to a thread of its own and returns at
// once; what that thread does not get to is skipped.
class View {
 public:
  // Null when the options ask for no pictures. Throws when they cannot be made.
  static std::unique_ptr<View> Make(const World& world, const PlantOptions& options);
  ~View();

  // Throws what went wrong, in the thread too.
  void Look(const World& world, int64_t frame_seq, int64_t exposure_us);

  // The newest frame that can be read from the ring.
  int64_t newest_frame_seq() const { return newest_frame_seq_; }

  // Finishes the files; throws if that fails.
  void Close();

 private:
  struct Shot {
    Snapshot snapshot;
    int64_t frame_seq = 0;
    int64_t exposure_us = 0;
  };

  View(const World& world, const PlantOptions& options);
  void PaintInThread(const World& world, const PlantOptions& options);
  void JoinThread();

  std::unique_ptr<Painter> painter_;  // made and used by one thread: a picture's context belongs to it
  Shot shot_;
  std::atomic<int64_t> newest_frame_seq_{0};

  std::thread thread_;
  Latest<Shot> shots_;
  std::atomic<bool> ready_{false}, stop_{false}, failed_{false};
  std::exception_ptr failure_;  // set before failed_
};

}  // namespace intabs
