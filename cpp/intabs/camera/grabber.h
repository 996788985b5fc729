// A live camera read in a thread of its own: its newest frame, for whoever looks.
#pragma once

#include <atomic>
#include <functional>
#include <memory>
#include <mutex>
#include <thread>

#include "intabs/camera/frame_source.h"

namespace intabs {

class Grabber {
 public:
  // `wake` is called from the thread after each frame.
  Grabber(std::unique_ptr<FrameSource> source, std::function<void()> wake);
  ~Grabber();  // waits for the source's Next() to return
  Grabber(const Grabber&) = delete;
  Grabber& operator=(const Grabber&) = delete;

  // Swaps the newest frame into `out`; false when there is none since the last time.
  bool Take(Frame& out);

  bool lost() const { return lost_; }  // the camera is away

 private:
  void Run();

  const std::unique_ptr<FrameSource> source_;
  const std::function<void()> wake_;
  std::atomic<bool> stop_{false}, lost_{false};
  std::mutex mutex_;
  Frame newest_;
  bool fresh_ = false;
  std::thread thread_;  // last: it uses the others
};

}  // namespace intabs
