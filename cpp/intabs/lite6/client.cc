#include "intabs/lite6/client.h"

#include <arpa/inet.h>
#include <netdb.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <stdexcept>

#include "intabs/lite6/errors.h"
#include "intabs/rt/periodic.h"

namespace intabs::lite6 {
namespace {

constexpr int64_t kConnectTimeoutUs = 2'000'000;
constexpr int64_t kFirstPauseUs = 100'000, kLongestPauseUs = 2'000'000;
constexpr int64_t kFirstReportPauseUs = 20'000, kLongestReportPauseUs = 1'000'000;
constexpr int64_t kEnableTimeoutUs = 5'000'000;
constexpr int64_t kBecomeReadyUs = 2'000'000, kStopUs = 3'000'000;
constexpr int64_t kHeartbeatUs = 10'000'000;   // the vendor's client: 30 s; the controller gives up after 90 s
constexpr int64_t kFreshReadyUs = 200'000;     // reports may still tell of the time before
constexpr int64_t kPumpReversalUs = 400'000;   // opened before it may close
constexpr size_t kMaxInput = 16384;

// Non-blocking socket that connects; -1 with errno if it cannot.
int StartConnect(uint32_t address, int port) {
  const int fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
  if (fd < 0) return -1;
  const int on = 1;
  setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof(on));
  sockaddr_in to{};
  to.sin_family = AF_INET;
  to.sin_port = htons(static_cast<uint16_t>(port));
  to.sin_addr.s_addr = address;
  if (connect(fd, reinterpret_cast<const sockaddr*>(&to), sizeof(to)) == 0 || errno == EINPROGRESS) return fd;
  const int error = errno;
  close(fd);
  errno = error;
  return -1;
}

int SocketError(int fd) {
  int error = 0;
  socklen_t length = sizeof(error);
  getsockopt(fd, SOL_SOCKET, SO_ERROR, &error, &length);
  return error;
}

bool MovesOrWaits(uint8_t state) { return state == 1 || state == 2; }

}  // namespace

Client::Client(const ClientOptions& options, const ArmModel& model, Log log, std::function<void()> on_thread)
    : options_(options), log_(std::move(log)), bridge_(model), on_thread_(std::move(on_thread)) {
  addrinfo hints{}, *found = nullptr;
  hints.ai_family = AF_INET;
  if (const int rc = getaddrinfo(options.host.c_str(), nullptr, &hints, &found); rc != 0) {
    throw std::runtime_error("host \"" + options.host + "\": " + gai_strerror(rc) + "; give the arm's address");
  }
  address_ = reinterpret_cast<const sockaddr_in*>(found->ai_addr)->sin_addr.s_addr;
  freeaddrinfo(found);
  input_.reserve(kMaxInput);
  report_input_.reserve(kMaxInput);
  wake_fd_ = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
  if (wake_fd_ < 0) throw std::runtime_error(std::string("eventfd: ") + std::strerror(errno));
  thread_ = std::thread([this] { Run(); });
}

Client::~Client() {
  stop_ = true;
  const uint64_t one = 1;
  (void)!write(wake_fd_, &one, sizeof(one));
  thread_.join();
  close(wake_fd_);
}

void Client::Send(const ClientOrder& order) noexcept {
  orders_.write_slot() = order;
  orders_.Publish();
  const uint64_t one = 1;
  (void)!write(wake_fd_, &one, sizeof(one));
}

void Client::Publish() {
  states_.write_slot() = state_;
  states_.Publish();
}

void Client::SetPhase(Phase phase) {
  state_.phase = phase;
  Publish();
}

void Client::Run() {
  if (on_thread_) on_thread_();
  int64_t pause_us = kFirstPauseUs;
  while (!stop_) {
    if (Connect()) {
      pause_us = kFirstPauseUs;
      ++state_.connections;
      last_complaint_.clear();
      Serve();
      Disconnect();
      if (!stop_) log_("connection to " + options_.host + " lost; connecting again");
    } else {
      const std::string complaint = "no arm at " + options_.host + ":" + std::to_string(options_.port) + " (" +
                                    std::strerror(errno) + "); trying again";
      if (complaint != last_complaint_) log_(complaint);
      last_complaint_ = complaint;
    }
    Sleep(pause_us);
    pause_us = std::min(2 * pause_us, kLongestPauseUs);
  }
}

void Client::Sleep(int64_t us) {
  for (const int64_t end = MonotonicUs() + us; !stop_ && MonotonicUs() < end;) Wait(end);
}

bool Client::Connect() {
  const int fd = StartConnect(address_, options_.port);
  if (fd < 0) return false;
  pollfd p{fd, POLLOUT, 0};
  const int64_t end = MonotonicUs() + kConnectTimeoutUs;
  while (!stop_ && p.revents == 0 && MonotonicUs() < end) poll(&p, 1, 100);
  const int error = p.revents == 0 ? ETIMEDOUT : SocketError(fd);
  if (error != 0 || stop_) {
    close(fd);
    errno = error;
    return false;
  }
  control_fd_ = fd;
  input_.clear();
  consumed_ = 0;
  tid_ = 1;
  protocol_ = kPlainProtocol;
  return true;
}

void Client::Disconnect() {
  close(control_fd_);
  control_fd_ = -1;
  CloseReport();
  report_retry_us_ = INT64_MAX;
  SetPhase(Phase::kDisconnected);
}

void Client::Serve() {
  Reply reply;
  if (!Call(Request::Bare(Register::kGetVersion), reply)) return;
  const std::string version(reinterpret_cast<const char*>(reply.payload),
                            strnlen(reinterpret_cast<const char*>(reply.payload), static_cast<size_t>(reply.size)));
  if (!version.starts_with("6,9,")) {
    log_("what answers at " + options_.host + " is no Lite 6: it calls itself \"" + version + "\"");
    return;
  }
  protocol_ = kHeartbeatProtocol;
  log_("connected to " + options_.host + ", " + version);
  stop_done_ = stopped_reported_ = false;
  if (options_.report_port != 0) {
    report_backoff_us_ = kFirstReportPauseUs;
    ConnectReport();
  }
  SetPhase(Phase::kConnected);

  while (!stop_) {
    const int64_t now_us = MonotonicUs();
    if (report_fd_ < 0 && now_us >= report_retry_us_) ConnectReport();
    if (!new_order_) {
      if (Wait(now_us + 100'000) == Waited::kLost) return;
    }
    if (new_order_) {
      new_order_ = false;
      const ClientOrder order = order_;
      if (!order.stop) stop_done_ = false;
      if (order.prepare != state_.prepare) {
        if (!Prepare(order.prepare)) return;
      } else if (order.stop && !stop_done_) {
        if (!StopArm()) return;
      } else if (state_.phase == Phase::kReady && order.epoch == state_.epoch) {
        if (!Stream(order)) return;
      }
    }
    if (state_.phase == Phase::kReady && stopped_reported_ && !AskWhatIsWrong()) return;
    if (MonotonicUs() - last_call_us_ > kHeartbeatUs && !Call(Request::Bare(Register::kGetState))) return;
  }
}

Client::Waited Client::Wait(int64_t until_us) {
  const int64_t left_us = std::max<int64_t>(until_us - MonotonicUs(), 0);
  pollfd fds[3] = {{wake_fd_, POLLIN, 0},
                   {control_fd_, POLLIN, 0},
                   {report_fd_, static_cast<short>(report_connecting_ ? POLLOUT : POLLIN), 0}};
  const timespec timeout{left_us / 1000000, (left_us % 1000000) * 1000};
  const int ready = ppoll(fds, 3, &timeout, nullptr);
  if (ready < 0 && errno != EINTR) return Waited::kLost;
  if (ready <= 0) return Waited::kTimeout;
  if (fds[0].revents != 0) {
    uint64_t count;
    (void)!read(wake_fd_, &count, sizeof(count));
    if (const ClientOrder* order = orders_.Take()) {
      order_ = *order;
      new_order_ = true;
    }
  }
  if (report_fd_ >= 0 && fds[2].revents != 0) ReadReport();
  if (control_fd_ >= 0 && fds[1].revents != 0) {
    uint8_t buffer[1024];
    const ssize_t n = recv(control_fd_, buffer, sizeof(buffer), 0);
    if (n == 0 || (n < 0 && errno != EAGAIN && errno != EINTR)) return Waited::kLost;
    if (n > 0) input_.insert(input_.end(), buffer, buffer + n);
    if (input_.size() > kMaxInput) return Waited::kLost;
  }
  return Waited::kSomething;
}

bool Client::Call(const Request& request, Reply& reply, int64_t timeout_us) {
  input_.erase(input_.begin(), input_.begin() + static_cast<ptrdiff_t>(consumed_));
  consumed_ = 0;
  Frame frame;
  const uint16_t tid = tid_;
  tid_ = tid == 65535 ? 1 : tid + 1;
  EncodeRequest(request, tid, protocol_, frame);
  const auto size = static_cast<size_t>(frame.size);
  if (send(control_fd_, frame.bytes.data(), size, MSG_NOSIGNAL) != static_cast<ssize_t>(size)) return false;
  last_call_us_ = MonotonicUs();
  for (const int64_t end = last_call_us_ + timeout_us;;) {
    FrameView view;
    size_t used = 0;
    const Parsed parsed = ParseFrame(input_.data() + consumed_, input_.size() - consumed_, view, used);
    if (parsed == Parsed::kFrame) {
      consumed_ += used;
      const ReplyFit fit = ReadReply(view, request.reg, tid, protocol_, reply);
      if (fit == ReplyFit::kOurs) return true;
      if (fit == ReplyFit::kIgnored) continue;
    }
    if (parsed != Parsed::kMore) {
      ++state_.bad_replies;
      log_("the controller's answer makes no sense; closing the connection");
      return false;
    }
    if (stop_ || MonotonicUs() >= end || Wait(end) == Waited::kLost) return false;
  }
}

bool Client::Prepare(uint32_t number) {
  state_.prepare = number;
  SetPhase(Phase::kPreparing);
  Reply reply;
  if (!Call(Request::Bare(Register::kCleanError)) || !Call(Request::Bare(Register::kCleanWarning)) ||
      !Call(Request::MotionEnable(true), reply, kEnableTimeoutUs) || !Call(Request::SetMode(options_.mode)) ||
      !Call(Request::SetState(VendorState::kReady))) {
    return false;
  }
  uint8_t arm_state = 0;
  for (const int64_t end = MonotonicUs() + kBecomeReadyUs; MonotonicUs() < end && !stop_;) {
    if (!Call(Request::Bare(Register::kGetState), reply)) return false;
    arm_state = reply.size > 0 ? reply.payload[0] : 0;
    if (MovesOrWaits(arm_state) || reply.error()) break;
    Sleep(20'000);
  }
  if (!MovesOrWaits(arm_state)) return AskWhatIsWrong();
  if (!ReadJointsNow()) return false;
  if (!Call(Request::ReadTool(kToolOutputsRead), reply)) return false;
  if (reply.size >= 4) {
    const uint32_t outputs = GetU32(reply.payload) & 3;
    gripper_ = outputs == 1 ? Gripper::kOpen : outputs == 2 ? Gripper::kClosed : Gripper::kStopped;
  }
  ready_us_ = MonotonicUs();
  stopped_reported_ = false;
  state_.vendor_error = 0;
  state_.q_ready = state_.q;
  state_.epoch = number;
  state_.reply_us = ready_us_;
  state_.slow = false;
  bridge_.Reset(state_.q, ready_us_);
  SetPhase(Phase::kReady);
  log_(options_.mode == VendorMode::kTeach ? "ready to be guided by hand" : "ready");
  return true;
}

bool Client::ReadJointsNow() {
  Reply reply;
  if (!Call(Request::GetJoints(3), reply)) return false;
  if (!ReadJoints(reply, 3, state_.q, state_.dq, state_.tau)) {
    ++state_.bad_replies;
    log_("the controller's joint values make no sense; closing the connection");
    return false;
  }
  state_.has_q = true;
  if (options_.report_port == 0) {
    state_.report_us = MonotonicUs();
    state_.report_age_limit_us = Bridge::kGapUs * 2;
  }
  Publish();
  return true;
}

bool Client::Stream(const ClientOrder& order) {
  if (options_.mode == VendorMode::kServo) {
    const int64_t begin_us = MonotonicUs();
    const JointVector& q = bridge_.Step(order.q, begin_us);
    Reply reply;
    if (!Call(Request::ServoJ(q), reply)) return false;
    if ((reply.status & (kStatusError | kStatusCannotMove | kStatusInvalid)) != 0) return AskWhatIsWrong();
    state_.reply_us = MonotonicUs();
    state_.round_trip_us = static_cast<float>(state_.reply_us - begin_us);
    // After a late answer the next step decides; until then the reference waits.
    state_.slow = bridge_.slow() || state_.reply_us - begin_us > Bridge::kGapUs;
    ++state_.targets;
    if ((reply.status & kStatusWarning) != 0) {
      if (!Call(Request::Bare(Register::kGetError), reply)) return false;
      if (reply.size >= 2) state_.vendor_warning = reply.payload[1];
      log_(WarningLine(state_.vendor_warning));
      if (!Call(Request::Bare(Register::kCleanWarning))) return false;
    }
    Publish();
  }
  if (options_.report_port == 0 && !ReadJointsNow()) return false;
  return !order.gripper_valid || UpdateGripper(order.gripper_closed);
}

bool Client::UpdateGripper(bool closed) {
  if (gripper_ == (closed ? Gripper::kClosed : Gripper::kOpen)) return true;
  if (MonotonicUs() < gripper_wait_us_) return true;
  if (closed && gripper_ != Gripper::kOpen) {
    // After a stop, closing does nothing before it was opened.
    gripper_wait_us_ = MonotonicUs() + kPumpReversalUs;
    return WriteGripper(false);
  }
  return WriteGripper(closed);
}

bool Client::WriteGripper(bool closed) {
  Reply first, second;
  if (!Call(Request::SetToolOutput(0, !closed), first) || !Call(Request::SetToolOutput(1, closed), second)) return false;
  gripper_ = closed ? Gripper::kClosed : Gripper::kOpen;
  return true;
}

bool Client::AskWhatIsWrong() {
  Reply reply;
  if (!Call(Request::Bare(Register::kGetError), reply)) return false;
  state_.vendor_error = reply.size >= 1 ? reply.payload[0] : 0;
  if (!Call(Request::Bare(Register::kGetState), reply)) return false;
  const int arm_state = reply.size > 0 ? reply.payload[0] : -1;
  log_(state_.vendor_error != 0
           ? ErrorLine(state_.vendor_error)
           : "the arm does not take targets (its state is " + std::to_string(arm_state) +
                 "): stopped, paused or switched to another mode by somebody else; send RESET");
  stopped_reported_ = false;
  SetPhase(Phase::kFault);
  return true;
}

bool Client::StopArm() {
  Reply reply;
  for (const int64_t end = MonotonicUs() + kStopUs; MonotonicUs() < end && !stop_;) {
    if (!Call(Request::SetState(VendorState::kStopped)) || !Call(Request::Bare(Register::kGetState), reply)) return false;
    if (reply.size > 0 && reply.payload[0] == static_cast<uint8_t>(VendorState::kStopped)) {
      stop_done_ = true;
      SetPhase(Phase::kStopped);
      return true;
    }
    Sleep(20'000);
  }
  log_("the arm does not obey the stop; closing the connection: use its emergency stop button");
  return false;
}

void Client::ConnectReport() {
  report_fd_ = StartConnect(address_, options_.report_port);
  report_connecting_ = report_fd_ >= 0;
  report_input_.clear();
  if (report_fd_ < 0) CloseReport();
}

void Client::CloseReport() {
  if (report_fd_ >= 0) close(report_fd_);
  report_fd_ = -1;
  report_connecting_ = false;
  report_retry_us_ = MonotonicUs() + report_backoff_us_;
  report_backoff_us_ = std::min(2 * report_backoff_us_, kLongestReportPauseUs);
  report_q_us_ = 0;
  if (options_.report_port != 0) state_.report_us = 0;
  Publish();
}

void Client::ReadReport() {
  if (report_connecting_) {
    report_connecting_ = false;
    if (const int error = SocketError(report_fd_); error != 0) {
      const std::string complaint = "no reports at port " + std::to_string(options_.report_port) + " (" +
                                    std::strerror(error) + "); trying again. Old firmware: --report-port 30003";
      if (complaint != last_complaint_) log_(complaint);
      last_complaint_ = complaint;
      CloseReport();
    }
    return;
  }
  uint8_t buffer[kMaxReportBytes];
  const ssize_t n = recv(report_fd_, buffer, sizeof(buffer), 0);
  if (n < 0 && (errno == EAGAIN || errno == EINTR)) return;
  if (n <= 0) {
    CloseReport();
    return;
  }
  report_input_.insert(report_input_.end(), buffer, buffer + n);
  const int64_t now_us = MonotonicUs();
  size_t begin = 0;
  for (;;) {
    ArmReport report;
    size_t used = 0;
    const Parsed parsed = ParseReport(report_input_.data() + begin, report_input_.size() - begin, report, used);
    if (parsed == Parsed::kBroken) {
      ++state_.bad_reports;
      log_("a report that makes no sense; connecting to the reports again");
      CloseReport();
      return;
    }
    if (parsed == Parsed::kMore) break;
    begin += used;
    TakeReport(report, now_us);
  }
  report_input_.erase(report_input_.begin(), report_input_.begin() + static_cast<ptrdiff_t>(begin));
  if (begin > 0) Publish();
}

void Client::TakeReport(const ArmReport& report, int64_t now_us) {
  report_backoff_us_ = kFirstReportPauseUs;
  if (report.has_dq) {
    state_.dq = report.dq;
  } else if (report_q_us_ != 0 && now_us > report_q_us_) {
    // Speeds are not reported: differences, smoothed over some 30 ms. Reports that come in a bunch tell nothing.
    const double dt = static_cast<double>(now_us - report_q_us_) * 1e-6;
    if (dt > 2e-3) state_.dq += std::min(dt / 0.03, 1.0) * ((report.q - state_.q) / dt - state_.dq);
  }
  if (report.has_dq || report_q_us_ == 0 || now_us - report_q_us_ > 2000) report_q_us_ = now_us;
  state_.q = report.q;
  state_.tau = report.tau;
  state_.has_q = true;
  state_.report_us = now_us;
  const bool fast = report.kind == ReportKind::kFull || report.kind == ReportKind::kReal;
  state_.report_age_limit_us = fast ? 2 * Bridge::kGapUs : 700'000;
  if (report.has_errors && report.error != 0) state_.vendor_error = report.error;
  if (state_.phase == Phase::kReady && now_us - ready_us_ > kFreshReadyUs &&
      (report.mode != options_.mode || !MovesOrWaits(static_cast<uint8_t>(report.state)))) {
    stopped_reported_ = true;
  }
}

}  // namespace intabs::lite6
