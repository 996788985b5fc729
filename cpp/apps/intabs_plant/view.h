// Everything that makes pictures of the plant: camera frames for perception, video, strip, window.
#pragma once

#include <atomic>
#include <cstdint>
#include <exception>
#include <memory>
#include <thread>

#include "intabs/plant/world.h"
#include "intabs/rt/latest.h"
#include "options.h"

namespace intabs {

class Painter;

// In lockstep the caller's thread draws. By the wall clock Look() leaves a snapshot to a thread of its own
// and returns at once; what that thread does not get to is skipped.
class View {
 public:
  // Null when the options ask for no pictures. Throws when they cannot be made.
  static std::unique_ptr<View> Make(const World& world, const PlantOptions& options);
  ~View();

  // Camera frames of the world as it is. Throws what went wrong, in the thread too.
  void Look(const World& world, int64_t frame_seq, int64_t exposure_us);

  // Lockstep: video, strip and window of what Look() saw; at leisure, while perception and control are at
  // work. By the wall clock the thread does it.
  void Film();

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

  std::unique_ptr<Painter> painter_;  // lockstep only
  Snapshot snapshot_;
  std::atomic<int64_t> newest_frame_seq_{0};

  std::thread thread_;
  Latest<Shot> shots_;
  std::atomic<bool> ready_{false}, stop_{false}, failed_{false};
  std::exception_ptr failure_;  // set before failed_
};

}  // namespace intabs
