#include "intabs/bus/lcm_log.h"

#include <lcm/eventlog.h>

#include <cerrno>
#include <cstdio>
#include <cstring>
#include <stdexcept>

namespace intabs {

LcmLogWriter::LcmLogWriter(const std::string& path)
    : path_(path), log_(lcm_eventlog_create(path.c_str(), "w")) {
  if (log_ == nullptr) throw std::runtime_error("cannot write " + path + ": " + std::strerror(errno));
}

LcmLogWriter::~LcmLogWriter() { lcm_eventlog_destroy(log_); }

void LcmLogWriter::Write(int64_t utime, const std::string& channel, const uint8_t* data, size_t size) {
  lcm_eventlog_event_t event{};
  event.timestamp = utime;
  event.channellen = static_cast<int32_t>(channel.size());
  event.datalen = static_cast<int32_t>(size);
  event.channel = const_cast<char*>(channel.c_str());
  event.data = const_cast<uint8_t*>(data);
  if (lcm_eventlog_write_event(log_, &event) != 0) {
    throw std::runtime_error("cannot write " + path_ + ": " + std::strerror(errno));
  }
}

void LcmLogWriter::Flush() {
  if (std::fflush(log_->f) != 0) {
    throw std::runtime_error("cannot write " + path_ + ": " + std::strerror(errno));
  }
}

}  // namespace intabs
