// Client and driver against a fake controller in the same process, over real sockets.
#include "intabs/lite6/driver.h"

#include <atomic>
#include <catch2/catch.hpp>
#include <random>
#include <string>
#include <thread>
#include <vector>

#include "common/alloc_hook.h"
#include "intabs/lite6/fake.h"
#include "intabs/rt/periodic.h"

namespace intabs::lite6 {
namespace {

const JointVector kHome = (JointVector() << 0, -.0164, .7773, 0, .7937, 0).finished();

// The controller on a thread of its own.
struct Controller {
  explicit Controller(FakeOptions options = {.port = 0, .report_port_base = 0}) : fake(options, kHome) {
    fake.on_request = [this](const uint8_t* data, size_t size) {
      const std::lock_guard lock(mutex);
      if (requests.size() < 64) requests.emplace_back(data, data + size);
    };
    thread = std::thread([this] { fake.Run([this] { return stop.load(); }); });
  }
  ~Controller() {
    stop = true;
    thread.join();
  }
  double Figure(const std::string& name) {
    const std::string json = fake.Order("state");
    return std::stod(json.substr(json.find("\"" + name + "\": ") + name.size() + 4));
  }

  std::mutex mutex;
  std::vector<std::vector<uint8_t>> requests;
  FakeController fake;
  std::atomic<bool> stop{false};
  std::thread thread;
};

// A driver whose ticks come by the clock, and a session that commands it 25 times a second.
struct Rig {
  explicit Rig(VendorMode mode = VendorMode::kServo, ReportKind kind = ReportKind::kFull)
      : driver({.client = {.host = "127.0.0.1",
                           .port = controller.fake.port(),
                           .report_port = controller.fake.report_port(kind),
                           .mode = mode}},
               [this](const std::string& line) {
                 const std::lock_guard lock(log_mutex);
                 log.push_back(line);
               }) {}

  void Tick() {
    (void)timer.Wait();
    if (session > 0 && ticks++ % 10 == 0) {
      const double t = 1e-6 * static_cast<double>(MonotonicUs() - begin_us);
      ArmCommand c;
      c.session = session;
      c.seq = ++seq;
      c.mode = ArmMode::kServo;
      c.q_target = kHome;
      c.q_target[0] = .3 * std::sin(1.5 * t);
      driver.Offer(c);
    }
    driver.Tick(MonotonicUs());
    if (driver.has_status()) driver.FillStatus(status);
    const bool moves = status.state == ArmState::kTracking || status.state == ArmState::kAligning;
    moving_without_link = moves && !driver.link_ok() ? moving_without_link + 1 : 0;
    worst_without_link = std::max(worst_without_link, moving_without_link);
  }
  template <class Condition>
  void Until(Condition condition) {
    const int64_t end_us = MonotonicUs() + 20'000'000;
    while (!condition()) {
      REQUIRE(MonotonicUs() < end_us);
      Tick();
    }
  }
  void UntilItMoves() {
    Until([this] { return status.state == ArmState::kTracking && status.dq.norm() > .1; });
  }
  bool Said(const std::string& text) {
    const std::lock_guard lock(log_mutex);
    return std::any_of(log.begin(), log.end(), [&](const auto& l) { return l.find(text) != std::string::npos; });
  }

  Controller controller;
  std::mutex log_mutex;
  std::vector<std::string> log;
  Driver driver;
  PeriodicTimer timer{kDriverPeriodUs};
  ArmStatus status;
  int64_t session = 0, seq = 0, ticks = 0, begin_us = MonotonicUs();
  int moving_without_link = 0, worst_without_link = 0;
};

}  // namespace

TEST_CASE("The first words of our client are those of the vendor's, and it prepares the arm") {
  Rig rig;
  rig.Until([&] { return rig.driver.client().phase == Phase::kReady; });
  const std::lock_guard lock(rig.controller.mutex);
  const auto& r = rig.controller.requests;
  CHECK(r.at(0) == std::vector<uint8_t>{0, 1, 0, 2, 0, 1, 1});
  CHECK(r.at(1) == std::vector<uint8_t>{0, 2, 0, 3, 0, 1, 0x10});
  CHECK(r.at(2) == std::vector<uint8_t>{0, 3, 0, 3, 0, 1, 0x11});
  CHECK(r.at(3) == std::vector<uint8_t>{0, 4, 0, 3, 0, 3, 0x0b, 8, 1});
  CHECK(r.at(4) == std::vector<uint8_t>{0, 5, 0, 3, 0, 3, 0x13, 1, 0});
  CHECK(r.at(5) == std::vector<uint8_t>{0, 6, 0, 3, 0, 2, 0x0c, 0});
}

TEST_CASE("It holds the pose it found, then follows a session") {
  Rig rig;
  rig.Until([&] { return rig.driver.client().targets > 20; });
  CHECK(rig.status.state == ArmState::kIdle);
  CHECK((rig.status.q - kHome).cwiseAbs().maxCoeff() < 1e-6);
  rig.session = 7;
  rig.UntilItMoves();
  CHECK(rig.status.session == 7);
  CHECK(rig.controller.Figure("max_joint_speed") < 2.2);
  CHECK(rig.controller.Figure("error") == 0);
}

TEST_CASE("Whatever breaks, no tick that knows of it moves on; after a RESET, or alone, it goes on") {
  for (const std::string order : {"delay 200", "silence 300", "mute 300", "corrupt 1", "corrupt 2", "corrupt 3", "drop reports",
                                  "drop", "garble", "error 31"}) {
    INFO(order);
    Rig rig;
    rig.session = 7;
    rig.UntilItMoves();
    rig.controller.fake.Order(order);
    rig.Until([&] { return rig.status.state != ArmState::kTracking; });
    CHECK(rig.status.state != ArmState::kAligning);
    const int64_t end_us = MonotonicUs() + 500'000;
    rig.Until([&] { return MonotonicUs() > end_us; });
    if (rig.status.state == ArmState::kFault) rig.driver.Reset(7);
    rig.UntilItMoves();
    CHECK(rig.worst_without_link <= 2);
    CHECK(rig.controller.Figure("max_joint_speed") <= 3.1416);
    CHECK(rig.controller.Figure("max_tip_speed") <= .6);
  }
}

TEST_CASE("Answers or reports that stay away make the arm hold before they are back") {
  for (const std::string verb : {"delay", "mute"}) {
    INFO(verb);
    Rig rig;
    rig.session = 7;
    rig.UntilItMoves();
    const int64_t back_us = MonotonicUs() + 1'500'000;
    rig.controller.fake.Order(verb + " 1500");
    rig.Until([&] { return rig.status.state == ArmState::kHolding || MonotonicUs() > back_us; });
    CHECK(MonotonicUs() < back_us);
    rig.UntilItMoves();
  }
}

TEST_CASE("The vendor's error is in the status, with its name in the log") {
  Rig rig;
  rig.session = 7;
  rig.UntilItMoves();
  rig.controller.fake.Order("error 60");
  rig.Until([&] { return rig.status.state == ArmState::kFault; });
  CHECK(rig.status.fault == Fault::kVendor);
  CHECK(rig.status.vendor_error == 60);
  CHECK(rig.Said("C60 linear speed"));
}

TEST_CASE("An ESTOP brakes the arm first, then stops the controller") {
  Rig rig;
  rig.session = 7;
  rig.Until([&] { return rig.status.state == ArmState::kTracking && rig.status.dq.norm() > .35; });
  rig.driver.Estop();
  rig.Until([&] { return rig.driver.client().phase == Phase::kStopped; });
  for (int i = 0; i < 50; ++i) rig.Tick();
  CHECK(rig.status.state == ArmState::kStopped);
  // It went all of the way that the reference braked on.
  CHECK((rig.status.q - rig.status.q_commanded).cwiseAbs().maxCoeff() < 2e-4);
}

TEST_CASE("A controller that somebody else stops is noticed") {
  Rig rig;
  rig.session = 7;
  rig.UntilItMoves();
  const ClientOptions other{.host = "127.0.0.1", .port = rig.controller.fake.port(), .report_port = 0,
                            .mode = VendorMode::kTeach};
  {
    Client client(other, ArmModel::Lite6(), [](const std::string&) {});
    ClientOrder order;
    order.prepare = 1;
    client.Send(order);  // switches the mode
    rig.Until([&] { return rig.status.state == ArmState::kFault; });
  }
  CHECK(rig.status.fault == Fault::kVendor);
  CHECK(rig.status.vendor_error == 0);
  rig.driver.Reset(7);
  rig.UntilItMoves();
}

TEST_CASE("What calls itself otherwise is not driven") {
  // A report port answers, but not as a controller does.
  Controller controller;
  std::atomic<bool> said{false};
  Client client({.host = "127.0.0.1", .port = controller.fake.report_port(ReportKind::kFull)}, ArmModel::Lite6(),
                [&](const std::string& line) { said = said || line.find("makes no sense") != std::string::npos; });
  for (int i = 0; i < 500 && !said; ++i) std::this_thread::sleep_for(std::chrono::milliseconds(10));
  CHECK(said);
}

TEST_CASE("The tick does not allocate, whatever the link does") {
  if (!AllocationHookActive()) {
    WARN("skipped: sanitizers own the allocator");
    return;
  }
  REQUIRE(AllocationHookSeesAll());
  Rig rig;
  rig.session = 7;
  rig.UntilItMoves();
  int64_t allocations = 0;
  const auto run = [&](int n) {
    for (int i = 0; i < n; ++i) {
      ArmCommand c;
      c.session = 7;
      c.seq = 1000000 + i;
      c.q_target = kHome;
      const AllocationCounter counter;  // of this thread
      rig.driver.Offer(c);
      rig.driver.Tick(MonotonicUs());
      rig.driver.FillStatus(rig.status);
      allocations += counter.count();
      (void)rig.timer.Wait();
    }
  };
  run(100);
  rig.controller.fake.Order("drop");
  run(50);
  rig.driver.Estop();
  run(20);
  rig.driver.Reset(7);
  run(50);
  CHECK(allocations == 0);
}

TEST_CASE("What is sent is the reference; after a gap it is caught up with, slowly if the gap was long") {
  const ArmModel model = ArmModel::Lite6();
  Bridge bridge(model);
  bridge.Reset(kHome, 0);
  int64_t now_us = 0;
  JointVector q = kHome;
  for (int i = 0; i < 100; ++i) {
    q[0] += .004;
    CHECK(bridge.Step(q, now_us += 4000) == q);
  }
  for (const int64_t gap_us : {12'000, 200'000}) {
    INFO(gap_us);
    q[0] -= .15;
    now_us += gap_us;
    JointVector last = bridge.sent();
    const double most = gap_us > Bridge::kGapUs ? Bridge::kSlowTipSpeed : Bridge::kTipSpeed;
    int ticks = 0;
    while (bridge.sent() != q && ++ticks < 10000) {
      const JointVector& sent = bridge.Step(q, now_us += 4000);
      CHECK((model.Tip(sent).p - model.Tip(last).p).norm() / .004 <= most * 1.001);
      CHECK((sent - last).cwiseAbs().maxCoeff() / .004 <= Bridge::kSpeed * 1.001);
      CHECK(bridge.slow() == (gap_us > Bridge::kGapUs && sent != q));
      last = sent;
    }
    CHECK(ticks > 1);
    CHECK(bridge.sent() == q);
    CHECK_FALSE(bridge.slow());
  }
}

}  // namespace intabs::lite6
