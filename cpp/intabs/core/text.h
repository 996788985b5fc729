#pragma once

#include <algorithm>
#include <string>

namespace intabs {

// For errors that quote what a file holds: control characters, line breaks among them, become blanks.
inline std::string OneLine(std::string text) {
  std::replace_if(text.begin(), text.end(), [](char c) { return (c >= 0 && c < ' ') || c == 127; }, ' ');
  return text;
}

}  // namespace intabs
