// Result of a real-time call. Loading and set-up throw instead.
#pragma once

namespace intabs {

enum class [[nodiscard]] Status {
  kOk = 0,
  kNotReady,     // nothing loaded, or no plan
  kInvalidInput,  // NaN, or an object this needs is not valid
  kOutOfRange,
  kFinished,     // the plan is played
};

}  // namespace intabs
