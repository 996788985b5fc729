// A controller to test against: FakeArm behind the real one's sockets, on the loopback interface only, with faults that
// can be ordered. `intabs_fake_lite6` is this and a command line.
#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "intabs/lite6/fake_arm.h"

namespace intabs::lite6 {

struct FakeOptions {
  int port = 502;                // 0: any free one, as for the others
  int report_port_base = 30000;  // full, normal, rich, real at base + 0 .. 3
  int orders_port = -1;          // text lines, see Order(); -1: none
  double heartbeat_s = 90;       // silence after which a client that promised a heartbeat is given up; 0: never
  // Faults that come again and again; 0: never.
  double delay_every_s = 0, drop_every_s = 0, corrupt_every_s = 0;
  int delay_ms = 200;  // how long no request is answered
};

class FakeController {
 public:
  // Called after every tick of 4 ms: whatever is moved by the arm, and measures it (FakeArm::Measure).
  using Body = std::function<void(FakeArm& arm)>;

  // Listens from here on. Throws when a port is taken or not allowed, with its number.
  FakeController(const FakeOptions& options, const JointVector& q, Body body = nullptr);
  ~FakeController();
  FakeController(const FakeController&) = delete;
  FakeController& operator=(const FakeController&) = delete;

  // Serves until `stop` says so; looked at every tick.
  void Run(const std::function<bool()>& stop);

  // One order as a line of text; the answer is one line of JSON, with "error" if it was not understood. From any thread.
  //   delay MS       no request is answered for so long      silence MS     nothing is sent at all for so long
  //   mute MS        no report is sent for so long
  //   drop           closes all connections                  drop reports   closes the report connections
  //   unplug S       closes all and refuses new ones         corrupt N      the next N reports are damaged
  //   garble         the next reply is of nothing asked      error CODE, warning CODE
  //   estop on|off   the button                              guide Q1 .. Q6 a hand leads the arm [rad] (manual mode)
  //   state          figures
  std::string Order(const std::string& line);

  int port() const { return port_; }
  int report_port_base() const { return report_ports_[0]; }
  // With port 0 the report ports are not consecutive.
  int report_port(ReportKind kind) const;
  int orders_port() const { return orders_port_; }

  // Every request as it came, header and all; for tests. Set it before Run().
  std::function<void(const uint8_t* data, size_t size)> on_request;

 private:
  enum class Kind { kControl, kFull, kNormal, kRich, kReal, kOrders };
  struct Connection;
  struct Listener {
    int fd;
    Kind kind;
  };

  int Listen(int port, Kind kind);
  void AcceptFrom(const Listener& listener);
  bool Serve(Connection& c);  // false: close it
  bool ServeControl(Connection& c);
  bool ServeOrders(Connection& c);
  void SendReports();
  void Close(const std::function<bool(const Connection&)>& which);
  void FaultsByTheClock();
  std::string Execute(const std::string& line);

  const FakeOptions options_;
  const Body body_;
  FakeArm arm_;
  std::mutex mutex_;  // held but while waiting
  std::vector<Listener> listeners_;
  std::vector<std::unique_ptr<Connection>> connections_;
  int port_ = 0, orders_port_ = -1;
  std::array<int, 4> report_ports_{};  // by port number: full, normal, rich, real

  int64_t tick_ = 0, now_us_ = 0;
  int64_t deaf_until_us_ = 0, mute_until_us_ = 0, unreported_until_us_ = 0, unplugged_until_us_ = 0;
  int64_t next_delay_us_ = 0, next_drop_us_ = 0, next_corrupt_us_ = 0;
  int corrupt_ = 0;
  bool garble_ = false;
  int64_t accepted_ = 0, dropped_ = 0;
};

}  // namespace intabs::lite6
