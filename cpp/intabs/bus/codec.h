// Core structs to datagrams and back. The layout of a datagram is that of proto_lcm/*.lcm.
#pragma once

#include <cstddef>
#include <cstdint>

namespace intabs {

// Largest payload of any message: beyond 1435 bytes with its channel's name LCM cuts a message into
// fragments, and fragments that come out of order lose it.
inline constexpr int kMaxMessageBytes = 1400;

// Writes the datagram of `m` to `out` (kMaxMessageBytes long) and returns its size. Never more than the room
// there is: strings are cut, counts clamped. Allocates for skill plans and tag detections only.
template <class M>
int Encode(const M& m, uint8_t* out);

// False, with `m` unspecified, for anything but a whole datagram of this type: wrong fingerprint, size, count
// or string, or a number that is not finite. ArmCommand alone may carry such numbers: the driver refuses and
// counts those by kind. Reads no byte outside [data, data + size) and throws nothing, whatever is in there.
template <class M>
[[nodiscard]] bool Decode(const uint8_t* data, size_t size, M& m) noexcept;

}  // namespace intabs
