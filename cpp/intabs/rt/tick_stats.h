// Distribution of a loop's times in fixed memory.
#pragma once

#include <array>
#include <cstdint>

namespace intabs {

// Histogram of durations from 0 to 67 s. Percentiles are the upper edge of a bin: never too low, at most 3.2
// % (or .1 us) too high; the maximum is exact. Real-time safe.
class TickStats {
 public:
  void Add(double us) noexcept;
  void Clear() noexcept { *this = TickStats(); }

  int64_t count() const noexcept { return count_; }
  double max_us() const noexcept { return max_us_; }
  // p in (0, 1]; 0 when nothing was added.
  double PercentileUs(double p) const noexcept;

 private:
  // In units of .1 us: 32 bins for 0 .. 31, then 32 for each factor of two up to 2^30.
  static constexpr int kBinsPerOctave = 32;
  static constexpr int kOctaves = 25;
  std::array<uint32_t, kBinsPerOctave*(1 + kOctaves)> bins_{};
  int64_t count_ = 0;
  double max_us_ = 0;
};

}  // namespace intabs
