#include "process.h"

#include <algorithm>
#include <cstdio>
#include <fstream>
#include <nlohmann/json.hpp>
#include <random>
#include <stdexcept>

#include "intabs/kinematics/urdf.h"
#include "intabs/rt/periodic.h"
#include "intabs/rt/realtime.h"
#include "intabs/rt/stop_signal.h"

namespace intabs {
namespace {

constexpr int kLoopPriority = 80, kClientPriority = 79, kPublisherPriority = 78;
constexpr int64_t kListenUs = 300'000;  // for another plant or driver, before saying anything

int64_t RandomId() {
  std::random_device device;
  return static_cast<int64_t>((uint64_t{device()} << 32 | device()) >> 1 | 1);
}

std::array<float, 3> Summary(const TickStats& s) {
  return {static_cast<float>(s.PercentileUs(0.5)), static_cast<float>(s.PercentileUs(0.99)),
          static_cast<float>(s.max_us())};
}

lite6::DriverOptions DriverOptionsOf(const Lite6Options& o) {
  lite6::DriverOptions d;
  d.client = {o.host, o.port, o.report_port, o.teach ? lite6::VendorMode::kTeach : lite6::VendorMode::kServo};
  if (!o.kinematics.empty()) {
    d.model = LoadArmModel(o.kinematics);
    d.limits.q_min = d.model.q_min();
    d.limits.q_max = d.model.q_max();
  }
  return d;
}

}  // namespace

Lite6Process::Lite6Process(const Lite6Options& options)
    : options_(options),
      in_(options.lcm, options.prefix),
      out_(options.lcm, options.prefix),
      source_(RandomId()),
      recorder_(options.flight, kTickRecordHeader, &FormatTickRecord) {
  in_.Subscribe(kLite6Status, [this](const ArmStatus& s) { heard_other_ |= s.source != source_; });
  for (const int64_t begin = MonotonicUs(); MonotonicUs() - begin < kListenUs && !StopRequested();) Listen(50);
  InstallEstopSignal();
  driver_.emplace(
      DriverOptionsOf(options), [this](const std::string& line) { Say(line); },
      [] { (void)EnterRealtime(kClientPriority); });
  in_.Subscribe(
      kLite6Command, [this](const ArmCommand& c) { driver_->Offer(c); }, [this] { driver_->CountUndecodable(); });
  in_.Subscribe(kEstop, [this](const Estop& e) {
    Say("ESTOP: " + e.reason);
    driver_->Estop();
  });
  in_.Subscribe(kReset, [this](const Reset& r) { driver_->Reset(r.session); });
  if (keys_.active()) Say(options.teach ? "keys: space ESTOP, g gripper" : "keys: space ESTOP");
}

Lite6Process::~Lite6Process() {
  stop_ = true;
  if (loop_.joinable()) loop_.join();
  ticks_done_.fetch_add(1);
  ticks_done_.notify_all();
  if (publisher_.joinable()) publisher_.join();
}

void Lite6Process::Say(const std::string& line) const { std::fprintf(stderr, "intabs_lite6: %s\n", line.c_str()); }

void Lite6Process::Listen(int timeout_ms) {
  if (in_.Handle(timeout_ms) < 0) throw std::runtime_error("LCM is broken on " + options_.lcm);
  if (heard_other_) {
    throw std::runtime_error("another plant or driver speaks on " + options_.prefix + "LITE6_STATUS at " +
                             options_.lcm + ": stop it, or give this one another --lcm or a --prefix");
  }
}

void Lite6Process::ReadKeys() {
  while (const char key = keys_.Take()) {
    if (key == ' ') {
      Say("ESTOP: key");
      driver_->Estop();
    } else if (key == 'g') {
      driver_->ToggleGripper();
    }
  }
}

void Lite6Process::Run() {
  publisher_ = std::thread([this] { PublishStatuses(); });
  std::promise<void> started;
  loop_ = std::thread([this, &started] { Loop(started); });
  started.get_future().get();
  while (!StopRequested()) {
    Listen(20);
    ReadKeys();
  }
  stop_ = true;
  loop_.join();
  if (!options_.json.empty()) WriteJson();
}

void Lite6Process::EnterLoop() {
  const RealtimeResult result = EnterRealtime(kLoopPriority, options_.cpu);
  if (result.ok()) return;
  std::string faults;
  for (const std::string& fault : result.faults) faults += (faults.empty() ? "" : "; ") + fault;
  if (options_.require_realtime) throw std::runtime_error("--require-realtime: " + faults);
  Say("not real-time: " + faults);
}

void Lite6Process::Loop(std::promise<void>& started) {
  try {
    EnterLoop();
    started.set_value();
  } catch (...) {
    started.set_exception(std::current_exception());
    return;
  }
  ArmState last_state = ArmState::kIdle;
  TickRecord record;
  PeriodicTimer timer(kDriverPeriodUs);
  TickStats wakeup, tick;
  began_us_ = MonotonicUs();
  int64_t second_us = began_us_, targets = 0;
  float tick_us = 0;
  while (!stop_) {
    const Wakeup w = timer.Wait();
    overruns_ += w.missed;
    ++ticks_;
    const int64_t begin_us = MonotonicUs();
    if (TakeEstopSignal()) driver_->Estop();
    driver_->Tick(begin_us);
    if (driver_->has_status()) {
      ArmStatus& status = statuses_.write_slot();
      driver_->FillStatus(status);
      status.source = source_;
      status.overruns = static_cast<int32_t>(overruns_);
      status.tick_us = tick_us;
      statuses_.Publish();
      const bool moves = status.state == ArmState::kTracking || status.state == ArmState::kAligning;
      without_link_ += !driver_->link_ok();
      moving_without_link_ = moves && !driver_->link_ok() ? moving_without_link_ + 1 : 0;
      worst_without_link_ = std::max(worst_without_link_, moving_without_link_);
      driver_->FillRecord(record);
      record.wakeup_us = static_cast<float>(w.latency_us);
      record.tick_us = tick_us;
      recorder_.Record(record);
      if (status.state != last_state && status.state == ArmState::kFault) recorder_.Trigger("fault");
      if (status.state != last_state && status.state == ArmState::kStopped) recorder_.Trigger("estop");
      last_state = status.state;
    }
    if (driver_->client().targets != targets) round_trip_total_.Add(driver_->client().round_trip_us);
    targets = driver_->client().targets;
    const int64_t end_us = MonotonicUs();
    tick_us = static_cast<float>(end_us - begin_us);
    for (TickStats* s : {&wakeup, &wakeup_total_}) s->Add(static_cast<double>(w.latency_us));
    for (TickStats* s : {&tick, &tick_total_}) s->Add(tick_us);
    if (end_us - second_us >= 1'000'000) {
      Figures& f = figures_.write_slot();
      f = {ticks_, overruns_, end_us, 1e6f * static_cast<float>(tick.count()) / static_cast<float>(end_us - second_us),
           Summary(wakeup), Summary(tick)};
      figures_.Publish();
      wakeup.Clear();
      tick.Clear();
      second_us = end_us;
    }
    ticks_done_.fetch_add(1, std::memory_order_release);
    ticks_done_.notify_one();
  }
  ended_us_ = MonotonicUs();
}

void Lite6Process::PublishStatuses() {
  (void)EnterRealtime(kPublisherPriority);  // a refusal is told by the loop
  int64_t loop_seq = 0;
  for (uint32_t seen = 0; !stop_;) {
    ticks_done_.wait(seen, std::memory_order_acquire);
    seen = ticks_done_.load(std::memory_order_acquire);
    if (const ArmStatus* status = statuses_.Take()) out_.Publish(kLite6Status, *status);
    if (const Figures* f = figures_.Take()) {
      LoopStatus m;
      m.utime = f->utime;
      m.seq = ++loop_seq;
      m.name = "lite6";
      m.ticks = f->ticks;
      m.overruns = f->overruns;
      m.rate_hz = f->rate_hz;
      m.wakeup_us = f->wakeup_us;
      m.tick_us = f->tick_us;
      out_.Publish(kLoopStatus, m);
    }
  }
}

void Lite6Process::WriteJson() const {
  const auto figures = [](const TickStats& s) {
    return nlohmann::json{
        {"p50", s.PercentileUs(0.5)}, {"p99", s.PercentileUs(0.99)}, {"max", s.max_us()}, {"n", s.count()}};
  };
  const lite6::ClientState& c = driver_->client();
  const nlohmann::json json = {{"lite6",
                                {{"ticks", ticks_},
                                 {"overruns", overruns_},
                                 {"wall_s", static_cast<double>(ended_us_ - began_us_) * 1e-6},
                                 {"wakeup_us", figures(wakeup_total_)},
                                 {"tick_us", figures(tick_total_)},
                                 {"round_trip_us", figures(round_trip_total_)},
                                 {"ticks_without_link", without_link_},
                                 {"worst_ticks_moving_without_link", worst_without_link_},
                                 {"targets", c.targets},
                                 {"connections", c.connections},
                                 {"bad_reports", c.bad_reports},
                                 {"bad_replies", c.bad_replies},
                                 {"dropped_commands", driver_->dropped_commands()},
                                 {"undecodable", in_.undecodable()}}}};
  std::ofstream out(options_.json);
  out << json.dump(2) << "\n";
  if (!out) throw std::runtime_error("cannot write " + options_.json);
}

}  // namespace intabs
