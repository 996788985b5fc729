#include "intabs/rt/tick_stats.h"

#include <algorithm>
#include <bit>
#include <cmath>

namespace intabs {
namespace {
constexpr double kUnitsPerUs = 10;
}

void TickStats::Add(double us) noexcept {
  if (!(us >= 0)) us = 0;
  max_us_ = std::max(max_us_, us);
  ++count_;
  const auto units = static_cast<uint64_t>(std::min(us * kUnitsPerUs, 0x3fffffff * 1.0));
  if (units < kBinsPerOctave) {
    ++bins_[units];
    return;
  }
  const int octave = std::bit_width(units) - 6;  // 0 for 32 .. 63
  const auto within = static_cast<int>(units >> octave) - kBinsPerOctave;
  ++bins_[kBinsPerOctave * (1 + octave) + within];
}

double TickStats::PercentileUs(double p) const noexcept {
  if (count_ == 0) return 0;
  const auto rank = std::max<int64_t>(1, static_cast<int64_t>(std::ceil(p * static_cast<double>(count_))));
  int64_t seen = 0;
  for (int bin = 0; bin < static_cast<int>(bins_.size()); ++bin) {
    seen += bins_[bin];
    if (seen < rank) continue;
    const int octave = std::max(bin / kBinsPerOctave - 1, 0);
    const int first = bin < kBinsPerOctave ? bin : kBinsPerOctave + bin % kBinsPerOctave;
    const double upper_edge = std::ldexp(first + 1, octave) / kUnitsPerUs;
    return std::min(upper_edge, max_us_);
  }
  return max_us_;
}

}  // namespace intabs
