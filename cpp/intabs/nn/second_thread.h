// A helper thread for work that splits in two. Started on first use (that allocates); later uses do not
// allocate. Where the helper does not get a CPU in time, the caller does both halves. A copy starts without a
// thread.
#pragma once

#include <atomic>
#include <thread>
#include <type_traits>

namespace intabs {

class SecondThread {
 public:
  SecondThread() = default;
  SecondThread(const SecondThread&) {}
  SecondThread& operator=(const SecondThread&) { return *this; }
  ~SecondThread() {
    if (!thread_.joinable()) return;
    Set(kQuit);
    thread_.join();
  }

  // Runs mine() here and theirs() there, and returns when both are done.
  template <typename Mine, typename Theirs>
  void Run(Mine&& mine, Theirs&& theirs) {
    if (!thread_.joinable()) thread_ = std::thread([this] { Loop(); });
    work_ = [](void* f) { (*static_cast<std::remove_reference_t<Theirs>*>(f))(); };
    argument_ = &theirs;
    Set(kWork);
    mine();
    int expected = kWork;
    if (state_.compare_exchange_strong(expected, kIdle, std::memory_order_acq_rel)) {
      theirs();
    } else {
      Await([](int s) { return s == kIdle; });
    }
  }

 private:
  enum { kIdle, kWork, kBusy, kQuit };

  void Set(int s) {
    state_.store(s, std::memory_order_release);
    state_.notify_one();
  }
  // The halves take about equally long: spin for a while (tens of microseconds) before going to sleep.
  template <typename Condition>
  int Await(Condition condition) {
    for (int spin = 0;; ++spin) {
      const int s = state_.load(std::memory_order_acquire);
      if (condition(s)) return s;
      if (spin >= 20000) state_.wait(s, std::memory_order_acquire);
    }
  }
  void Loop() {
    while (Await([](int s) { return s != kIdle; }) != kQuit) {
      int expected = kWork;
      if (!state_.compare_exchange_strong(expected, kBusy, std::memory_order_acq_rel)) continue;
      work_(argument_);
      Set(kIdle);
    }
  }

  std::atomic<int> state_{kIdle};
  void (*work_)(void*) = nullptr;
  void* argument_ = nullptr;
  std::thread thread_;
};

}  // namespace intabs
