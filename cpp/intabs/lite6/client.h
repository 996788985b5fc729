// The connection to the arm's controller, on a thread of its own: connects, enables, streams joint targets, reads
// reports, comes back after whatever cuts it. The tick never waits for it: orders and states pass through latest-value
// slots.
#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <string>
#include <thread>
#include <vector>

#include "intabs/control/arm_controller.h"
#include "intabs/core/types.h"
#include "intabs/lite6/bridge.h"
#include "intabs/lite6/report.h"
#include "intabs/lite6/wire.h"
#include "intabs/rt/latest.h"

namespace intabs::lite6 {

enum class Phase : uint8_t {
  kDisconnected,  // no connection; tries again with growing pauses (.1 to 2 s)
  kConnected,     // it answers, but nothing has been prepared since
  kPreparing,     // clearing errors, enabling, setting the mode
  kReady,         // takes targets (or is in manual mode)
  kFault,         // stopped on its own: vendor_error, 0 if it only stopped, paused or changed mode
  kStopped,       // by our order
};

// From the tick to the client.
struct ClientOrder {
  JointVector q = JointVector::Zero();  // target [rad]
  uint32_t epoch = 0;                   // of the preparation that `q` goes on from; of another one it is ignored
  uint32_t prepare = 0;                 // a higher number than before: clear errors and enable once more
  bool stop = false;                    // stop the arm's controller (vendor's state 4)
  bool gripper_valid = false;           // leave the gripper alone unless
  bool gripper_closed = false;
};

// From the client to the tick. Times: the host's monotonic clock [us], 0: never.
struct ClientState {
  Phase phase = Phase::kDisconnected;
  uint32_t epoch = 0;    // number of the last preparation that succeeded ...
  uint32_t prepare = 0;  // ... and of the last that was tried
  JointVector q_ready = JointVector::Zero();  // where the arm stood then [rad]
  int64_t reply_us = 0;   // last good answer to a target
  int64_t report_us = 0;  // last good report; 0 from a broken one until the next good one
  int64_t report_age_limit_us = 0;
  bool has_q = false;     // q has been measured at all
  JointVector q = JointVector::Zero(), dq = JointVector::Zero(), tau = JointVector::Zero();
  bool slow = false;      // making good a gap: hold the reference
  int vendor_error = 0, vendor_warning = 0;
  int64_t targets = 0;    // answered
  int64_t connections = 0, bad_reports = 0, bad_replies = 0;
  float round_trip_us = 0;  // of the last target
};

struct ClientOptions {
  std::string host;
  int port = 502;
  int report_port = 30000;  // 30000 or 30003; 0: ask for the joints after every target instead
  VendorMode mode = VendorMode::kServo;  // or kTeach
};

class Client {
 public:
  using Log = std::function<void(const std::string& line)>;  // runs on the client's thread

  // `on_thread` runs first on the client's thread: its priority. Throws if the host is not a name or an address.
  Client(const ClientOptions& options, const ArmModel& model, Log log, std::function<void()> on_thread = nullptr);
  ~Client();
  Client(const Client&) = delete;
  Client& operator=(const Client&) = delete;

  // The tick's side, one thread; real-time safe: no lock, no allocation; one write to an eventfd wakes the client.
  void Send(const ClientOrder& order) noexcept;
  // Null if nothing changed since.
  const ClientState* Take() noexcept { return states_.Take(); }

 private:
  enum class Waited { kSomething, kTimeout, kLost };

  void Run();
  bool Connect();
  void Serve();
  void Disconnect();
  void Sleep(int64_t us);

  // Waits for anything on any socket and takes reports in.
  Waited Wait(int64_t until_us);
  // One request and its reply. False: the connection is lost. `reply` points into the input until the next call.
  bool Call(const Request& request, Reply& reply, int64_t timeout_us = 2'000'000);
  bool Call(const Request& request) {
    Reply reply;
    return Call(request, reply);
  }
  // False: the connection is lost. Whether it worked is in state_.phase.
  bool Prepare(uint32_t number);
  bool Stream(const ClientOrder& order);
  bool StopArm();
  bool UpdateGripper(bool closed);
  bool WriteGripper(bool closed);
  bool AskWhatIsWrong();  // after a target was refused or a report says the arm stopped
  bool ReadJointsNow();

  void ConnectReport();
  void CloseReport();
  void ReadReport();
  void TakeReport(const ArmReport& report, int64_t now_us);
  void Publish();
  void SetPhase(Phase phase);

  const ClientOptions options_;
  uint32_t address_ = 0;  // of the host, in network order: names are looked up once
  const Log log_;
  Bridge bridge_;
  Latest<ClientOrder> orders_;
  Latest<ClientState> states_;
  ClientState state_;
  ClientOrder order_;
  bool new_order_ = false;

  int wake_fd_ = -1, control_fd_ = -1, report_fd_ = -1;
  uint16_t tid_ = 1, protocol_ = kPlainProtocol;
  std::vector<uint8_t> input_, report_input_;
  size_t consumed_ = 0;  // of input_, by the reply handed out last
  bool report_connecting_ = false;
  int64_t report_retry_us_ = 0, report_backoff_us_ = 0;
  int64_t report_q_us_ = 0;  // of state_.q, for speeds that are not reported
  int64_t ready_us_ = 0, last_call_us_ = 0;
  bool stopped_reported_ = false;  // a report says the arm does not move any more though it should
  bool stop_done_ = false;

  enum class Gripper { kUnknown, kStopped, kOpen, kClosed };
  Gripper gripper_ = Gripper::kUnknown;
  int64_t gripper_wait_us_ = 0;

  std::string last_complaint_;
  std::atomic<bool> stop_{false};
  std::function<void()> on_thread_;
  std::thread thread_;
};

}  // namespace intabs::lite6
