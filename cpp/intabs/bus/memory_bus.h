// The twin of LcmBus for tests and in-process runs: no network, no thread, the same bytes.
#pragma once

#include <cstring>
#include <string>
#include <utility>
#include <vector>

#include "intabs/bus/bus.h"

namespace intabs {

// Publisher and subscribers share one object. Handle() never waits; what a handler publishes comes with the
// next Handle().
class MemoryBus final : public Bus {
 public:
  explicit MemoryBus(std::string prefix = "") : Bus(std::move(prefix)) {}

  int Handle(int /*timeout_ms*/) override {
    std::vector<Datagram> batch;
    batch.swap(waiting_);
    for (const Datagram& d : batch) {
      for (Subscriber& s : subscribers_) {
        if (s.channel == d.channel) s.handler(d.bytes.data(), d.bytes.size());
      }
    }
    return static_cast<int>(batch.size());
  }
  bool PublishBytes(const std::string& channel, const uint8_t* data, size_t size) override {
    waiting_.push_back({prefix_ + channel, {data, data + size}});
    return true;
  }
  void SubscribeBytes(const std::string& channel, BytesHandler handler) override {
    subscribers_.push_back({prefix_ + channel, std::move(handler)});
  }

 private:
  struct Datagram {
    std::string channel;
    std::vector<uint8_t> bytes;
  };
  struct Subscriber {
    std::string channel;
    BytesHandler handler;
  };
  std::vector<Datagram> waiting_;
  std::vector<Subscriber> subscribers_;
};

}  // namespace intabs
