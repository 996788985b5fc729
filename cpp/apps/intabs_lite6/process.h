// The driver of one arm on the bus. Three threads, and the client's in the driver: the loop (real-time, no I/O but one
// wake-up of the client and one of the publisher), the publisher, and the caller's, which hears the bus and the keys.
#pragma once

#include <array>
#include <atomic>
#include <cstdint>
#include <future>
#include <optional>
#include <string>
#include <thread>

#include "intabs/bus/lcm_bus.h"
#include "intabs/lite6/driver.h"
#include "intabs/control/tick_record.h"
#include "intabs/rt/estop_input.h"
#include "intabs/rt/flight_recorder.h"
#include "intabs/rt/latest.h"
#include "intabs/rt/tick_stats.h"

namespace intabs {

struct Lite6Options {
  std::string host;
  int port = 502;
  int report_port = 30000;
  bool teach = false;
  std::string kinematics;  // empty: the nominal arm
  bool require_realtime = false;
  int cpu = -1;  // to pin the loop to; -1: none
  std::string flight = "out/flight";  // folder of the flight recorder
  std::string lcm = kDefaultLcmUrl;
  std::string prefix;
  std::string json;  // empty: none
};

class Lite6Process {
 public:
  // Throws on what cannot work; listens a moment for another plant or driver on the same channels.
  explicit Lite6Process(const Lite6Options& options);
  ~Lite6Process();

  // Until a stop signal. Throws when another plant or driver turns up.
  void Run();

 private:
  struct Figures {  // of the last second
    int64_t ticks = 0, overruns = 0, utime = 0;
    float rate_hz = 0;
    std::array<float, 3> wakeup_us{}, tick_us{};
  };

  void Listen(int timeout_ms);
  void ReadKeys();
  // `started` is told when the thread has, or has not, got its real-time rights.
  void Loop(std::promise<void>& started);
  void EnterLoop();
  void PublishStatuses();
  void Say(const std::string& line) const;
  void WriteJson() const;

  const Lite6Options options_;
  LcmBus in_, out_;  // one a thread
  const int64_t source_;
  std::optional<lite6::Driver> driver_;  // once nobody else was heard
  bool heard_other_ = false;
  int64_t undecodable_ = 0;

  std::atomic<bool> stop_{false};
  std::atomic<uint32_t> ticks_done_{0};
  Latest<ArmStatus> statuses_;
  Latest<Figures> figures_;
  FlightRecorder<TickRecord> recorder_;
  Keys keys_;
  // The loop's; read by others when it has ended.
  int64_t ticks_ = 0, overruns_ = 0, began_us_ = 0, ended_us_ = 0;
  int64_t without_link_ = 0, moving_without_link_ = 0, worst_without_link_ = 0;
  TickStats wakeup_total_, tick_total_, round_trip_total_;
  std::thread loop_, publisher_;
};

}  // namespace intabs
