// A helper thread for work that splits in two. Started on first use (that allocates); later uses do not
// allocate. Where the helper does not get a CPU in time, the caller does both halves. A copy starts without a
// thread.
#pragma once

#include <atomic>
#include <chrono>
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
  // The halves take about equally long, and waking a thread costs more than they differ: look for a while
  // before going to sleep.
  template <typename Condition>
  int Await(Condition condition) {
    constexpr auto kPatience = std::chrono::microseconds(500);
    std::chrono::steady_clock::time_point start;
    for (unsigned look = 0;; ++look) {
      const int s = state_.load(std::memory_order_acquire);
      if (condition(s)) return s;
      if (look % 64 == 0) {
        const auto now = std::chrono::steady_clock::now();
        if (look == 0) start = now;
        if (now - start > kPatience) state_.wait(s, std::memory_order_acquire);
        std::this_thread::yield();  // both may be on one CPU
      }
#if defined(__x86_64__)
      __builtin_ia32_pause();
#endif
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
