#include "intabs/camera/grabber.h"

#include <utility>

namespace intabs {

Grabber::Grabber(std::unique_ptr<FrameSource> source, std::function<void()> wake)
    : source_(std::move(source)), wake_(std::move(wake)), thread_([this] { Run(); }) {}

Grabber::~Grabber() {
  stop_ = true;
  thread_.join();
}

void Grabber::Run() {
  Frame frame;
  while (!stop_) {
    const Grab grab = source_->Next(frame);
    lost_ = grab == Grab::kLost || grab == Grab::kEnd;
    if (grab == Grab::kEnd) return;
    if (grab != Grab::kFrame) continue;
    {
      const std::lock_guard lock(mutex_);
      std::swap(newest_, frame);
      fresh_ = true;
    }
    wake_();
  }
}

bool Grabber::Take(Frame& out) {
  const std::lock_guard lock(mutex_);
  if (!fresh_) return false;
  std::swap(newest_, out);
  fresh_ = false;
  return true;
}

}  // namespace intabs
