// The physical limit of one step: read as many bytes as the weights hold, once, in every way that might be
// the fastest.
#pragma once

#include <cstddef>
#include <string>
#include <vector>

namespace intabs::bench {

struct MemoryReader {
  std::string name;
  float (*read)(const float* data, size_t floats);  // floats: a multiple of 256; data 64-byte aligned
};

std::vector<MemoryReader> MemoryReaders();  // those that this CPU can run

}  // namespace intabs::bench
