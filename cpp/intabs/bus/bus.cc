#include "intabs/bus/bus.h"

#include <stdexcept>

namespace intabs {

Bus::Bus(std::string prefix) : prefix_(std::move(prefix)) {
  const auto is_plain = [](char c) {
    return c == '_' || (c >= '0' && c <= '9') || (c >= 'A' && c <= 'Z') || (c >= 'a' && c <= 'z');
  };
  for (const char c : prefix_) {
    if (!is_plain(c)) {
      throw std::runtime_error("channel prefix \"" + prefix_ +
                               "\": only letters, digits and underscores, like MASTER_");
    }
  }
}

}  // namespace intabs
