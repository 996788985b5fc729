#include "intabs/lite6/fake.h"

#include <arpa/inet.h>
#include <fcntl.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <sstream>
#include <stdexcept>

#include "intabs/rt/periodic.h"

namespace intabs::lite6 {
namespace {

constexpr size_t kMaxInput = 4096;
constexpr int kTicksPerSlowReport = 50;  // 5 Hz

int64_t AfterSeconds(int64_t now_us, double s) { return now_us + static_cast<int64_t>(s * 1e6); }

}  // namespace

struct FakeController::Connection {
  int fd;
  Kind kind;
  std::vector<uint8_t> input;
  bool heartbeat = false;  // promised
  int64_t heard_us = 0;
  bool closed = false;
};

FakeController::FakeController(const FakeOptions& options, const JointVector& q, Body body)
    : options_(options), body_(std::move(body)), arm_(q) {
  port_ = Listen(options.port, Kind::kControl);
  constexpr std::array kinds = {Kind::kFull, Kind::kNormal, Kind::kRich, Kind::kReal};
  for (int i = 0; i < 4; ++i) {
    report_ports_[static_cast<size_t>(i)] =
        Listen(options.report_port_base == 0 ? 0 : options.report_port_base + i, kinds[static_cast<size_t>(i)]);
  }
  if (options.orders_port >= 0) orders_port_ = Listen(options.orders_port, Kind::kOrders);
}

FakeController::~FakeController() {
  for (const Listener& l : listeners_) close(l.fd);
  for (const auto& c : connections_) close(c->fd);
}

int FakeController::Listen(int port, Kind kind) {
  const int fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
  const int on = 1;
  setsockopt(fd, SOL_SOCKET, SO_REUSEADDR, &on, sizeof(on));
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_port = htons(static_cast<uint16_t>(port));
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  socklen_t length = sizeof(address);
  if (bind(fd, reinterpret_cast<sockaddr*>(&address), length) != 0 || listen(fd, 8) != 0 ||
      getsockname(fd, reinterpret_cast<sockaddr*>(&address), &length) != 0) {
    const std::string why = std::strerror(errno);
    close(fd);
    for (const Listener& l : listeners_) close(l.fd);
    listeners_.clear();
    throw std::runtime_error("cannot listen on 127.0.0.1:" + std::to_string(port) + ": " + why +
                             "; give other ports with --port and --report-port-base");
  }
  listeners_.push_back({fd, kind});
  return ntohs(address.sin_port);
}

int FakeController::report_port(ReportKind kind) const {
  switch (kind) {
    case ReportKind::kFull: return report_ports_[0];
    case ReportKind::kNormal: return report_ports_[1];
    case ReportKind::kRich: return report_ports_[2];
    default: return report_ports_[3];
  }
}

void FakeController::Run(const std::function<bool()>& stop) {
  int64_t due_us = MonotonicUs();
  next_delay_us_ = AfterSeconds(due_us, options_.delay_every_s);
  next_drop_us_ = AfterSeconds(due_us, options_.drop_every_s);
  next_corrupt_us_ = AfterSeconds(due_us, options_.corrupt_every_s);
  std::vector<pollfd> fds;
  while (!stop()) {
    {
      const std::lock_guard lock(mutex_);
      fds.clear();
      for (const Listener& l : listeners_) fds.push_back({l.fd, POLLIN, 0});
      const bool deaf = MonotonicUs() < std::max(deaf_until_us_, mute_until_us_);
      for (const auto& c : connections_) {
        // A deaf controller leaves the requests in the socket.
        const bool listens = !(deaf && c->kind == Kind::kControl);
        fds.push_back({c->fd, static_cast<short>(listens ? POLLIN : 0), 0});
      }
    }
    const int64_t wait_us = std::max<int64_t>(due_us - MonotonicUs(), 0);
    const timespec timeout{wait_us / 1000000, (wait_us % 1000000) * 1000};
    ppoll(fds.data(), fds.size(), &timeout, nullptr);

    const std::lock_guard lock(mutex_);
    now_us_ = MonotonicUs();
    const size_t n_listeners = listeners_.size(), n_connections = connections_.size();
    for (size_t i = 0; i < n_connections; ++i) {
      Connection& c = *connections_[i];
      if (fds[n_listeners + i].revents != 0 && !c.closed) c.closed = !Serve(c);
    }
    for (size_t i = 0; i < n_listeners; ++i) {
      if (fds[i].revents != 0) AcceptFrom(listeners_[i]);
    }
    // Ticks that were missed are made up for, as the real controller would not have missed them; not a second's worth.
    if (now_us_ - due_us > 1'000'000) due_us = now_us_ - 1'000'000;
    for (; due_us <= now_us_; due_us += kDriverPeriodUs) {
      arm_.Tick();
      if (body_) body_(arm_);
      ++tick_;
      FaultsByTheClock();
      SendReports();
    }
    for (const auto& c : connections_) {
      if (c->heartbeat && options_.heartbeat_s > 0 && now_us_ > AfterSeconds(c->heard_us, options_.heartbeat_s)) {
        arm_.LoseHeartbeat();
        c->closed = true;
      }
    }
    std::erase_if(connections_, [](const auto& c) {
      if (c->closed) close(c->fd);
      return c->closed;
    });
  }
}

void FakeController::AcceptFrom(const Listener& listener) {
  const int fd = accept4(listener.fd, nullptr, nullptr, SOCK_CLOEXEC | SOCK_NONBLOCK);
  if (fd < 0) return;
  if (now_us_ < unplugged_until_us_ && listener.kind != Kind::kOrders) {
    close(fd);
    return;
  }
  const int on = 1;
  setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof(on));
  auto c = std::make_unique<Connection>();
  c->fd = fd;
  c->kind = listener.kind;
  c->heard_us = now_us_;
  connections_.push_back(std::move(c));
  ++accepted_;
}

bool FakeController::Serve(Connection& c) {
  uint8_t buffer[1024];
  const ssize_t n = recv(c.fd, buffer, sizeof(buffer), 0);
  if (n < 0) return errno == EAGAIN || errno == EINTR;
  if (n == 0) return false;
  if (c.kind != Kind::kControl && c.kind != Kind::kOrders) return true;  // nothing is asked on report ports
  c.input.insert(c.input.end(), buffer, buffer + n);
  if (c.input.size() > kMaxInput) return false;
  return c.kind == Kind::kControl ? ServeControl(c) : ServeOrders(c);
}

bool FakeController::ServeControl(Connection& c) {
  size_t begin = 0;
  FrameView request;
  size_t used = 0;
  for (;;) {
    const Parsed parsed = ParseFrame(c.input.data() + begin, c.input.size() - begin, request, used);
    if (parsed == Parsed::kBroken) return false;
    if (parsed == Parsed::kMore) break;
    if (on_request) on_request(c.input.data() + begin, used);
    begin += used;
    c.heard_us = now_us_;
    c.heartbeat |= request.protocol == kHeartbeatProtocol;
    Frame reply;
    arm_.Handle(request, reply);
    if (garble_) {
      reply.bytes[6] ^= 0x55;
      garble_ = false;
    }
    const auto size = static_cast<size_t>(reply.size);
    if (send(c.fd, reply.bytes.data(), size, MSG_NOSIGNAL) != static_cast<ssize_t>(size)) return false;
  }
  c.input.erase(c.input.begin(), c.input.begin() + static_cast<ptrdiff_t>(begin));
  return true;
}

bool FakeController::ServeOrders(Connection& c) {
  for (;;) {
    const auto end = std::find(c.input.begin(), c.input.end(), '\n');
    if (end == c.input.end()) return true;
    const std::string line(c.input.begin(), end);
    c.input.erase(c.input.begin(), end + 1);
    const std::string answer = Execute(line) + "\n";
    if (send(c.fd, answer.data(), answer.size(), MSG_NOSIGNAL) < 0) return false;
  }
}

void FakeController::SendReports() {
  if (now_us_ < std::max(mute_until_us_, unreported_until_us_)) return;
  uint8_t report[kMaxReportBytes];
  for (const auto& c : connections_) {
    ReportKind kind;
    bool due = true;
    switch (c->kind) {
      case Kind::kFull:
        kind = ReportKind::kFull;
        break;
      case Kind::kReal:
        kind = ReportKind::kReal;
        due = tick_ % 5 == 0 || tick_ % 5 == 2;  // 100 Hz
        break;
      case Kind::kNormal:
        kind = ReportKind::kNormal;
        due = tick_ % kTicksPerSlowReport == 0;
        break;
      case Kind::kRich:
        kind = ReportKind::kRich;
        due = tick_ % kTicksPerSlowReport == 0;
        break;
      default:
        continue;
    }
    if (!due || c->closed) continue;
    const auto size =
        static_cast<size_t>(EncodeReport(arm_.Report(kind), tick_ * kDriverPeriodUs, arm_.q_target(), report));
    if (corrupt_ > 0) {
      // In turn: a size that cannot be, numbers that cannot be, a mode that cannot be.
      if (corrupt_ % 3 == 0) report[0] ^= 0x7f;
      if (corrupt_ % 3 == 1) std::memset(report + 7, 0xff, size - 7);
      if (corrupt_ % 3 == 2) report[kind == ReportKind::kFull ? 12 : 4] = 0xff;
      --corrupt_;
    }
    // Who does not read is dropped: half a frame would be worse.
    if (send(c->fd, report, size, MSG_NOSIGNAL) != static_cast<ssize_t>(size)) c->closed = true;
  }
}

void FakeController::Close(const std::function<bool(const Connection&)>& which) {
  for (const auto& c : connections_) {
    if (!which(*c)) continue;
    c->closed = true;
    ++dropped_;
  }
}

void FakeController::FaultsByTheClock() {
  if (options_.delay_every_s > 0 && now_us_ >= next_delay_us_) {
    Execute("delay " + std::to_string(options_.delay_ms));
    next_delay_us_ = AfterSeconds(now_us_, options_.delay_every_s);
  }
  if (options_.drop_every_s > 0 && now_us_ >= next_drop_us_) {
    Execute("drop");
    next_drop_us_ = AfterSeconds(now_us_, options_.drop_every_s);
  }
  if (options_.corrupt_every_s > 0 && now_us_ >= next_corrupt_us_) {
    Execute("corrupt 1");
    next_corrupt_us_ = AfterSeconds(now_us_, options_.corrupt_every_s);
  }
}

std::string FakeController::Order(const std::string& line) {
  const std::lock_guard lock(mutex_);
  now_us_ = MonotonicUs();
  return Execute(line);
}

std::string FakeController::Execute(const std::string& line) {
  std::istringstream in(line);
  std::string verb, word;
  double number = 0;
  in >> verb;
  const std::string done = "{\"ok\": true, \"utime\": " + std::to_string(now_us_) + "}";
  if (verb == "state") {
    std::string json = arm_.Json();
    json.pop_back();
    return json + ", \"connections\": " + std::to_string(connections_.size()) +
           ", \"accepted\": " + std::to_string(accepted_) + ", \"dropped\": " + std::to_string(dropped_) +
           ", \"utime\": " + std::to_string(now_us_) + "}";
  }
  if (verb == "drop") {
    in >> word;
    Close([&](const Connection& c) {
      return c.kind != Kind::kOrders && !(word == "reports" && c.kind == Kind::kControl);
    });
    return done;
  }
  if (verb == "garble") {
    garble_ = true;
    return done;
  }
  if (verb == "estop" && in >> word && (word == "on" || word == "off")) {
    arm_.SetEstopButton(word == "on");
    return done;
  }
  if (verb == "guide") {
    JointVector q;
    for (int i = 0; i < kNumJoints; ++i) in >> q[i];
    if (in && q.allFinite()) {
      arm_.Guide(q);
      return done;
    }
  } else if (in >> number && number >= 0 && number < 1e6) {
    const auto n = static_cast<int>(number);
    if (verb == "delay") {
      deaf_until_us_ = now_us_ + n * int64_t{1000};
      return done;
    }
    if (verb == "mute") {
      unreported_until_us_ = now_us_ + n * int64_t{1000};
      return done;
    }
    if (verb == "silence") {
      mute_until_us_ = now_us_ + n * int64_t{1000};
      return done;
    }
    if (verb == "unplug") {
      unplugged_until_us_ = AfterSeconds(now_us_, number);
      Close([](const Connection& c) { return c.kind != Kind::kOrders; });
      return done;
    }
    if (verb == "corrupt") {
      corrupt_ = n;
      return done;
    }
    if (verb == "error" && n < 256) {
      arm_.RaiseError(n);
      return done;
    }
    if (verb == "warning" && n < 256) {
      arm_.RaiseWarning(n);
      return done;
    }
  }
  return R"({"error": "orders: delay MS, silence MS, mute MS, drop [reports], unplug S, corrupt N, garble, error N, warning N, )"
         R"(estop on|off, guide Q1 .. Q6, state"})";
}

}  // namespace intabs::lite6
