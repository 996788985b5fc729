// SHA-256 (FIPS 180-4), for checking weights files at load. Not real-time safe.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>

namespace intabs {

// Lower-case hexadecimal digest, 64 characters.
std::string Sha256Hex(const uint8_t* data, size_t size);

}  // namespace intabs
