#include "plant.h"

#include <algorithm>
#include <cstdio>
#include <fstream>
#include <nlohmann/json.hpp>
#include <random>
#include <stdexcept>

#include "intabs/rt/estop_input.h"
#include "intabs/rt/periodic.h"
#include "intabs/rt/stop_signal.h"

namespace intabs {
namespace {

constexpr int kTicksPerPolicyTick = static_cast<int>(kPolicyPeriodUs / kDriverPeriodUs);
constexpr int64_t kListenUs = 300'000;      // for another plant, before saying anything
constexpr int64_t kResendUs = 20'000;       // lockstep
constexpr int64_t kStrangerUs = 1'000'000;  // a stranger answered: so long for the session in command
constexpr int64_t kSilenceUs = 10'000'000;

int64_t RandomId() {
  std::random_device device;
  return static_cast<int64_t>((uint64_t{device()} << 32 | device()) >> 1 | 1);
}

std::array<float, 3> Summary(const TickStats& s) {
  return {static_cast<float>(s.PercentileUs(0.5)), static_cast<float>(s.PercentileUs(0.99)),
          static_cast<float>(s.max_us())};
}

}  // namespace

Plant::Plant(const PlantOptions& options)
    : options_(options),
      bus_(options.lcm, options.prefix),
      sim_(options.models, options.task),
      source_(RandomId()) {
  bus_.Subscribe(kLite6Status, [this](const ArmStatus& s) { OnStatus(s); });
  bus_.Subscribe(
      kLite6Command, [this](const ArmCommand& c) { OnCommand(c); },
      [this] { sim_.controller().CountUndecodable(); });
  bus_.Subscribe(kPlantControl, [this](const PlantControl& c) { OnControl(c); });
  bus_.Subscribe(kEstop, [this](const Estop& e) {
    if (sim_.controller().state() != ArmState::kStopped) {
      std::fprintf(stderr, "intabs_plant: ESTOP: %s\n", e.reason.c_str());
    }
    sim_.controller().Estop();
  });
  bus_.Subscribe(kReset, [this](const Reset& r) { sim_.controller().ResetFault(r.session); });
  InstallEstopSignal();

  for (const int64_t begin = MonotonicUs(); MonotonicUs() - begin < kListenUs && !StopRequested();)
    Handle(50);
  StartOver(options.seed, options.spread);
  // Last: others see what this makes (shared memory, files, a window).
  view_ = View::Make(sim_.world(), options_);
}

void Plant::Run() {
  started_us_ = loop_status_us_ = MonotonicUs();
  if (Lockstep()) {
    RunLockstep();
  } else {
    RunWall();
  }
  if (view_) view_->Close();
  if (!options_.json.empty()) WriteJson();
}

void Plant::RunLockstep() {
  while (!StopRequested()) {
    Look();
    if (!WaitForAnswer()) continue;
    for (int i = 0; i < kTicksPerPolicyTick; ++i) {
      if (i > 0) PublishStatus();
      Tick();
    }
  }
}

bool Plant::WaitForAnswer() {
  answer_ = Answer::kNone;
  started_over_ = false;
  ++truth_seq_;
  const int64_t begin_us = MonotonicUs();
  int64_t sent_us = begin_us;
  PublishTruth();
  PublishStatus();
  if (view_) view_->Film();
  while (!StopRequested()) {
    const int64_t until_resend_us = kResendUs - (MonotonicUs() - sent_us);
    Handle(static_cast<int>(std::max<int64_t>(until_resend_us + 999, 0) / 1000));
    PublishLoopStatusNowAndThen();
    if (started_over_) return false;
    const int64_t now_us = MonotonicUs();
    if (answer_ == Answer::kGiven) return true;
    if (answer_ == Answer::kStranger && now_us - begin_us > kStrangerUs) return true;
    if (now_us - begin_us > kSilenceUs) {
      throw std::runtime_error("no LITE6_COMMAND answered for 10 s, at " +
                               std::to_string(sim_.world().time_us() / 1000) +
                               " ms of simulation: start intabs_control on " + options_.lcm +
                               " and send it a plan, or see what it said");
    }
    if (now_us - sent_us >= kResendUs) {
      PublishTruth();
      PublishStatus();
      sent_us = now_us;
    }
  }
  return false;
}

void Plant::RunWall() {
  PeriodicTimer timer(kDriverPeriodUs);
  for (int tick = 0; !StopRequested(); tick = (tick + 1) % kTicksPerPolicyTick) {
    const Wakeup wakeup = timer.Wait();
    overruns_ += wakeup.missed;
    wakeup_stats_.Add(static_cast<double>(wakeup.latency_us));
    wakeup_total_.Add(static_cast<double>(wakeup.latency_us));
    Handle(0);
    Tick();
    if (tick == 0) {
      Look();
      ++truth_seq_;
      PublishTruth();
    }
    PublishStatus();
    PublishLoopStatusNowAndThen();
  }
}

// In lockstep only the answer to the status that the plant waits with may move anything, or the run would
// depend on when messages happen to arrive.
void Plant::OnCommand(const ArmCommand& c) {
  ArmController& controller = sim_.controller();
  const int64_t now_us = NowUs();
  if (!Lockstep()) {
    (void)controller.Accept(c, now_us);
    return;
  }
  if (c.session == last_session_ && c.seq == last_seq_) return;  // sent again, because ours was sent again
  ArmStatus waiting;
  sim_.Status(waiting);
  if (answer_ == Answer::kGiven || c.status_seq != status_seq_base_ + waiting.seq) {
    const Refusal refusal = controller.Check(c, now_us);
    controller.Count(refusal == Refusal::kAccepted ? Refusal::kOldSequence : refusal);
    return;
  }
  const bool in_command = controller.Busy(now_us);
  const Refusal refusal = controller.Accept(c, now_us);
  if (c.session <= 0) return;
  if (refusal == Refusal::kForeignSession && in_command) {
    answer_ = Answer::kStranger;
    return;
  }
  answer_ = Answer::kGiven;
  answered_us_ = MonotonicUs();
  last_session_ = c.session;
  last_seq_ = c.seq;
}

// A session that only holds does not mind a reset. In lockstep time stands still with one that died: its arm moves
// for ever, but nobody answers any more.
bool Plant::Moves() const {
  const ArmState state = sim_.controller().state();
  const bool alive = !Lockstep() || MonotonicUs() - answered_us_ < kStrangerUs;
  return alive &&
         (state == ArmState::kAligning || state == ArmState::kTracking || state == ArmState::kSlowing);
}

void Plant::OnStatus(const ArmStatus& s) { heard_other_ |= s.source != source_; }

void Plant::OnControl(const PlantControl& c) {
  if (!c.reset) return;
  const ArmState state = sim_.controller().state();
  const char* reason = nullptr;
  if (!c.task.empty() && c.task != options_.task) {
    reason = "it runs another task: start another plant";
  } else if (state == ArmState::kFault || state == ArmState::kStopped) {
    reason = "the arm is in fault or stopped: send RESET first";
  } else if (Moves()) {
    reason = "a session moves the arm";
  } else if (!(c.spread >= 0 && c.spread <= World::kMaxSpread)) {
    reason = "the spread must be 0 to 15 cm";
  }
  if (reason != nullptr) {
    std::fprintf(stderr, "intabs_plant: PLANT_CONTROL refused: %s\n", reason);
    return;
  }
  StartOver(c.seed, c.spread);
}

void Plant::Handle(int timeout_ms) {
  if (bus_.Handle(timeout_ms) < 0) throw std::runtime_error("LCM is broken on " + options_.lcm);
  if (TakeEstopSignal()) sim_.controller().Estop();
  if (heard_other_) {
    throw std::runtime_error("another plant or driver speaks on LITE6_STATUS at " + options_.lcm +
                             ": stop it, or give this one another --lcm or a --prefix");
  }
}

int64_t Plant::NowUs() const { return Lockstep() ? sim_.world().time_us() : MonotonicUs(); }

void Plant::StartOver(int64_t seed, double spread_cm) {
  ArmStatus last;
  sim_.Status(last);
  status_seq_base_ += last.seq;
  sim_.Reset(seed, spread_cm, Lockstep() ? 0 : MonotonicUs());
  started_over_ = true;
}

void Plant::Tick() {
  const int64_t begin_us = MonotonicUs();
  if (Lockstep()) {
    sim_.Tick();
  } else {
    sim_.Tick(begin_us);
  }
  tick_us_ = static_cast<float>(MonotonicUs() - begin_us);
  tick_stats_.Add(tick_us_);
  tick_total_.Add(tick_us_);
  ++ticks_;
}

void Plant::Look() {
  ++frame_seq_;
  if (view_) view_->Look(sim_.world(), frame_seq_, NowUs());
}

void Plant::PublishTruth() {
  PlantTruth truth;
  sim_.Truth(truth);
  truth.utime = NowUs();
  truth.seq = truth_seq_;
  truth.frame_seq = frame_seq_;
  bus_.Publish(kPlantTruth, truth);
}

void Plant::PublishStatus() {
  ArmStatus status;
  sim_.Status(status);
  status.utime = NowUs();
  status.seq += status_seq_base_;
  status.source = source_;
  status.last_frame_seq = view_ ? view_->newest_frame_seq() : frame_seq_;
  status.overruns = static_cast<int32_t>(overruns_);
  status.tick_us = tick_us_;
  bus_.Publish(kLite6Status, status);
}

void Plant::PublishLoopStatusNowAndThen() {
  const int64_t now_us = MonotonicUs();
  if (now_us - loop_status_us_ < 1'000'000) return;
  LoopStatus loop;
  loop.utime = NowUs();
  loop.seq = ++loop_seq_;
  loop.name = "plant";
  loop.ticks = ticks_;
  loop.overruns = overruns_;
  loop.rate_hz = static_cast<float>(1e6 * static_cast<double>(tick_stats_.count()) /
                                    static_cast<double>(now_us - loop_status_us_));
  loop.wakeup_us = Summary(wakeup_stats_);
  loop.tick_us = Summary(tick_stats_);
  bus_.Publish(kLoopStatus, loop);
  loop_status_us_ = now_us;
  wakeup_stats_.Clear();
  tick_stats_.Clear();
}

void Plant::WriteJson() const {
  const auto figures = [](const TickStats& s) {
    return nlohmann::json{{"p50", s.PercentileUs(0.5)}, {"p99", s.PercentileUs(0.99)}, {"max", s.max_us()}};
  };
  const double wall_s = static_cast<double>(MonotonicUs() - started_us_) * 1e-6;
  const nlohmann::json json = {{"plant",
                                {{"ticks", ticks_},
                                 {"overruns", overruns_},
                                 {"undecodable", bus_.undecodable()},
                                 {"simulated_s", static_cast<double>(ticks_ * kDriverPeriodUs) * 1e-6},
                                 {"wall_s", wall_s},
                                 {"tick_us", figures(tick_total_)},
                                 {"wakeup_us", figures(wakeup_total_)}}}};
  std::ofstream out(options_.json);
  out << json.dump(2) << "\n";
  if (!out) throw std::runtime_error("cannot write " + options_.json);
}

}  // namespace intabs
