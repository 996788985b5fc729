// A file of lcm-logger's format: what LCM carried, with the time it was received.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>

struct _lcm_eventlog_t;

namespace intabs {

// Not real-time safe. Whatever was flushed is a whole log: a program that dies leaves one that ends earlier.
class LcmLogWriter {
 public:
  // Throws one line if the file cannot be made. Overwrites.
  explicit LcmLogWriter(const std::string& path);
  ~LcmLogWriter();
  LcmLogWriter(const LcmLogWriter&) = delete;
  LcmLogWriter& operator=(const LcmLogWriter&) = delete;

  // utime: of the receipt, us since 1970. Throws when the disk is full.
  void Write(int64_t utime, const std::string& channel, const uint8_t* data, size_t size);
  void Flush();  // throws like Write

 private:
  const std::string path_;
  _lcm_eventlog_t* log_;
};

}  // namespace intabs
