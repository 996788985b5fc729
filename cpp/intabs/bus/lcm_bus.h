// The bus between processes: LCM over UDP multicast.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "intabs/bus/bus.h"

struct _lcm_t;

namespace intabs {

inline const std::string kDefaultLcmUrl = "udpm://239.255.76.67:7667?ttl=0";

class LcmBus final : public Bus {
 public:
  // Throws one line, with the cure, when there is no multicast route or LCM refuses the URL.
  explicit LcmBus(const std::string& url, std::string prefix = "");
  ~LcmBus() override;

  // At most kMaxBatch messages a call, so that a flood on one channel cannot stop the caller's loop.
  int Handle(int timeout_ms) override;
  bool PublishBytes(const std::string& channel, const uint8_t* data, size_t size) override;
  void SubscribeBytes(const std::string& channel, BytesHandler handler) override;

  // Every channel there is, of any prefix, under its full name; utime: of the receipt, us since 1970. What
  // was subscribed earlier is handed out first.
  using AnyHandler =
      std::function<void(int64_t utime, const std::string& channel, const uint8_t* data, size_t size)>;
  void SubscribeAll(AnyHandler handler);

  static constexpr int kMaxBatch = 1000;

 private:
  _lcm_t* lcm_;
  std::vector<std::unique_ptr<BytesHandler>> handlers_;
  std::vector<std::unique_ptr<AnyHandler>> any_handlers_;
  std::string channel_;  // prefix and name of what is being published, kept for its memory
};

}  // namespace intabs
