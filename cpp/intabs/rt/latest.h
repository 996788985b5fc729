// Hands the newest value from one thread to another; neither ever waits.
#pragma once

#include <array>
#include <atomic>

namespace intabs {

// Triple buffer for one writer and one reader thread. The three values live as long as the slot and are
// reused, so that what they own is allocated once. Real-time safe as far as T's own writes are.
template <class T>
class Latest {
 public:
  // Writer: fill this, then Publish(). It holds an old value.
  T& write_slot() noexcept { return values_[write_]; }
  void Publish() noexcept { write_ = shared_.exchange(write_ | kNew, std::memory_order_acq_rel) & ~kNew; }

  // Reader: the newest value, or null if there is none since the last call. It stays untouched until the next
  // call.
  const T* Take() noexcept {
    if ((shared_.load(std::memory_order_relaxed) & kNew) == 0) return nullptr;
    read_ = shared_.exchange(read_, std::memory_order_acq_rel) & ~kNew;
    return &values_[read_];
  }

 private:
  static constexpr int kNew = 4;
  std::array<T, 3> values_{};
  int write_ = 0;
  int read_ = 1;
  std::atomic<int> shared_{2};  // index of the slot between the two, and whether it is new
};

}  // namespace intabs
