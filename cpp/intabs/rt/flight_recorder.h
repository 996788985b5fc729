// The last seconds of a loop, kept in memory, written to a file after a fault by a thread of their own.
#pragma once

#include <array>
#include <atomic>
#include <chrono>
#include <cstdio>
#include <cstring>
#include <ctime>
#include <filesystem>
#include <semaphore>
#include <string>
#include <thread>
#include <type_traits>
#include <vector>

namespace intabs {

// One loop thread calls Record and Trigger: real-time safe, they copy one T and never wait. T is trivially
// copyable. There are two rings: while one is written, the loop goes on in the other.
template <class T>
class FlightRecorder {
  static_assert(std::is_trivially_copyable_v<T>);

 public:
  // Writes one row without its end of line; returns its length, as snprintf does.
  using Format = int (*)(const T& row, char* out, size_t size);

  // Keeps `before` rows up to a trigger and `after` more (both at least 1). Files go to `folder` (made if it
  // is not there): flight-<date>-<time>-<reason>.csv with `header` as their first line. Starts the writer.
  FlightRecorder(std::string folder, std::string header, Format format, size_t before = 2500,
                 size_t after = 250)
      : folder_(std::move(folder)), header_(std::move(header)), format_(format), after_(after) {
    for (Ring& ring : rings_) ring.rows.resize(before + after);
    writer_ = std::thread([this] { Write(); });
  }
  // Writes what has been triggered, complete or not.
  ~FlightRecorder() {
    if (left_ > 0) HandOver();
    ended_ = true;
    ready_.release();
    writer_.join();
  }
  FlightRecorder(const FlightRecorder&) = delete;
  FlightRecorder& operator=(const FlightRecorder&) = delete;

  void Record(const T& row) noexcept {
    Ring& ring = rings_[current_];
    ring.rows[ring.next] = row;
    if (++ring.next == ring.rows.size()) {
      ring.next = 0;
      ring.full = true;
    }
    if (left_ > 0 && --left_ == 0) HandOver();
  }

  // From now on `after` more rows are recorded, then all of it is written. `reason`: letters and digits, cut
  // to 31. While a trigger is under way another one changes nothing.
  void Trigger(const char* reason) noexcept {
    if (left_ > 0) return;
    left_ = after_;
    std::strncpy(rings_[current_].reason, reason, sizeof(Ring::reason) - 1);
  }

  // Files written; triggers lost because the writer was still at the one before, or could not write.
  int written() const noexcept { return written_; }
  int lost() const noexcept { return lost_; }

 private:
  struct Ring {
    std::vector<T> rows;
    size_t next = 0;
    bool full = false;
    char reason[32] = "";
  };

  void HandOver() noexcept {
    left_ = 0;
    if (busy_.exchange(true, std::memory_order_acquire)) {
      ++lost_;
      return;
    }
    full_ring_ = current_;
    current_ = 1 - current_;
    Ring& fresh = rings_[current_];
    fresh.next = 0;
    fresh.full = false;
    std::memset(fresh.reason, 0, sizeof fresh.reason);
    waiting_.store(true, std::memory_order_release);
    ready_.release();
  }

  void Write() {
    while (true) {
      ready_.acquire();
      if (waiting_.exchange(false, std::memory_order_acquire)) {
        const std::string fault = WriteFile(rings_[full_ring_]);
        if (fault.empty()) {
          ++written_;
        } else {
          ++lost_;
          std::fprintf(stderr, "flight recorder: %s\n", fault.c_str());
        }
        busy_.store(false, std::memory_order_release);
      } else if (ended_) {
        return;
      }
    }
  }

  std::string WriteFile(const Ring& ring) const {
    char when[32];
    const std::time_t now = std::time(nullptr);
    std::tm date{};
    localtime_r(&now, &date);
    std::strftime(when, sizeof when, "%Y%m%d-%H%M%S", &date);
    std::error_code code;
    std::filesystem::create_directories(folder_, code);
    std::string path;
    for (int n = 0; path.empty() || std::filesystem::exists(path, code); ++n) {
      path =
          folder_ + "/flight-" + when + "-" + ring.reason + (n > 0 ? "-" + std::to_string(n) : "") + ".csv";
    }
    const std::string partial = path + ".partial";
    std::FILE* file = std::fopen(partial.c_str(), "w");
    if (file == nullptr) return "cannot write " + partial + ": " + std::strerror(errno);
    std::fprintf(file, "%s\n", header_.c_str());
    std::vector<char> line(4096);
    const size_t size = ring.full ? ring.rows.size() : ring.next;
    const size_t first = ring.full ? ring.next : 0;
    for (size_t i = 0; i < size; ++i) {
      format_(ring.rows[(first + i) % ring.rows.size()], line.data(), line.size());
      std::fprintf(file, "%s\n", line.data());
    }
    const bool good = std::ferror(file) == 0;
    if (std::fclose(file) != 0 || !good) return "cannot write " + partial + ": " + std::strerror(errno);
    std::filesystem::rename(partial, path, code);
    if (code) return "cannot write " + path + ": " + code.message();
    std::fprintf(stderr, "flight recorder: wrote %s\n", path.c_str());
    return "";
  }

  const std::string folder_, header_;
  const Format format_;
  const size_t after_;
  std::array<Ring, 2> rings_;
  int current_ = 0, full_ring_ = 0;
  size_t left_ = 0;  // rows to come before a trigger is complete
  std::atomic<bool> busy_{false}, waiting_{false}, ended_{false};
  std::atomic<int> written_{0}, lost_{0};
  std::counting_semaphore<> ready_{0};
  std::thread writer_;
};

}  // namespace intabs
