// intabs_control: plays skill plans. LITE6_STATUS + OBJECT_POSES -> pi -> LITE6_COMMAND, 25 Hz.
#include <CLI/CLI.hpp>
#include <chrono>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <nlohmann/json.hpp>
#include <optional>
#include <random>

#include "../common/hand_eye.h"
#include "../common/yaml_config.h"
#include "intabs/bus/lcm_bus.h"
#include "intabs/rt/periodic.h"
#include "intabs/rt/stop_signal.h"
#include "intabs/rt/tick_stats.h"
#include "intabs/skills/skill_controller.h"
#include "intabs/skills/skill_library.h"
#include "plan_receiver.h"

namespace intabs {
namespace {

constexpr int64_t kSilenceUs = 10'000'000;  // of the plant or driver while a plan is played
constexpr int64_t kStatusAgeUs = 500'000;   // wall clock: an older status is no base for a command

struct Options {
  std::string lcm = kDefaultLcmUrl;
  std::string prefix;
  std::string weights = "models/weights/lite6";
  std::string perception = "tags";
  std::string clock = "lockstep";
  std::string hand_eye;
  std::string json;
};

const char* Describe(EndReason reason) {
  switch (reason) {
    case EndReason::kFinished: return "finished";
    case EndReason::kAborted: return "aborted";
    case EndReason::kStalePoses: return "object poses are older than 2.5 s: is perception running?";
    case EndReason::kBadInput: return "a reading or the policy's output is not finite";
    case EndReason::kNoEffect: return "an object did not move as in the demonstration, however often it was tried";
    case EndReason::kRefused: return "the driver is in fault, stopped, or obeys another session";
    default: return "";
  }
}

class Control {
 public:
  explicit Control(const Options& options)
      : options_(options),
        bus_(options.lcm, options.prefix),
        controller_(SkillPlayer::Load(options.weights, ArmModel::Lite6()), RandomSession()) {
    if (!options.hand_eye.empty()) X_BW_ = LoadHandEye(options.hand_eye).Inverse();
    bus_.Subscribe(kLite6Status, std::function<void(const ArmStatus&)>([this](const ArmStatus& s) { OnStatus(s); }));
    bus_.Subscribe(kSkillPlan, std::function<void(const SkillPlan&)>([this](const SkillPlan& p) { OnPlan(p); }));
    bus_.Subscribe(kSkillControl, std::function<void(const SkillControl&)>([this](const SkillControl& c) { OnControl(c); }));
    // PLANT_TRUTH is listened to under --perception truth alone.
    if (options.perception == "truth") {
      bus_.Subscribe(kPlantTruth, std::function<void(const PlantTruth&)>([this](const PlantTruth& t) {
        OnPoses(PosesFromTruth(t));
      }));
    } else {
      bus_.Subscribe(kObjectPoses, std::function<void(const ObjectPoses&)>([this](const ObjectPoses& p) { OnPoses(p); }));
    }
  }

  void Run() {
    if (options_.clock == "lockstep") {
      RunLockstep();
    } else {
      RunWall();
    }
    PublishLoopStatus();
  }

  void WriteJson(const std::string& path) const {
    const nlohmann::json figures = {
        {"control",
         {{"rate_hz", Rate()},
          {"ticks", ticks_},
          {"overruns", overruns_},
          {"undecodable", bus_.undecodable()},
          {"latency_us", {{"p50", tick_us_.PercentileUs(0.5)},
            {"p99", tick_us_.PercentileUs(0.99)},
            {"max", tick_us_.max_us()}}}}},
        {"policy", {{"infer_us", {{"p50", infer_us_.PercentileUs(0.5)}, {"p99", infer_us_.PercentileUs(0.99)}}}}},
        {"end_reason", Describe(controller_.player().status().end_reason)}};
    std::ofstream out(path);
    out << figures.dump(2) << "\n";
    if (!out) throw std::runtime_error("cannot write " + path);
  }

 private:
  static int64_t RandomSession() {
    std::random_device device;
    return static_cast<int64_t>((uint64_t{device()} << 32 | device()) >> 1 | 1);
  }

  void OnStatus(const ArmStatus& s) {
    heard_us_ = MonotonicUs();
    if (s.source != source_) poses_.reset();  // another plant or driver: what was seen before is of another world
    source_ = s.source;
    // Lockstep: only statuses on the policy's grid are answered; the plant waits there.
    if (options_.clock == "lockstep" && s.utime % kPolicyPeriodUs != 0) return;
    status_.Offer(s);
  }

  // The policy knows the arm's base alone. In the plant that is W.
  void OnPoses(const ObjectPoses& p) {
    // Late ones. After a reset of the plant time starts again, the frames go on counting.
    if (poses_ && p.exposure_utime < poses_->exposure_utime && p.frame_seq <= poses_->frame_seq) return;
    poses_ = p;
    if (!X_BW_) return;
    for (TrackedObject& o : poses_->objects) {
      if (o.id >= 0) o.X_WO = *X_BW_ * o.X_WO;
    }
  }

  void OnPlan(const SkillPlan& part) {
    if (part.plan_id == controller_.player().status().plan_id) {
      PublishSkillStatus();  // a re-send: the sender has not heard us
      return;
    }
    const std::vector<Skill>& library = controller_.player().library()->skills;
    if (!plan_.Add(part, library)) return;
    if (controller_.Start(plan_.id(), plan_.skills()) != Status::kOk) {
      std::fprintf(stderr,
                   "intabs_control: plan %ld refused: %zu skills; it needs 1 to %d, each lasting 1 tick or more, of a library of %zu\n",
                   static_cast<long>(plan_.id()), plan_.skills().size(), kMaxSkills, library.size());
      return;
    }
    started_ = true;
    said_ = false;
    started_us_ = heard_us_ = MonotonicUs();
    PublishSkillStatus();
  }

  void OnControl(const SkillControl& c) {
    if (c.plan_id != controller_.player().status().plan_id) return;
    if (c.action == SkillControl::kAbort) controller_.Abort(EndReason::kAborted);
    controller_.Pause(c.action == SkillControl::kPause);
  }

  // One policy tick and its answer.
  void Answer(const ArmStatus& status, const ObjectPoses& poses) {
    const auto before = std::chrono::steady_clock::now();
    (void)controller_.Tick(status, poses, command_);
    bus_.Publish(kLite6Command, command_);
    tick_us_.Add(std::chrono::duration<double, std::micro>(std::chrono::steady_clock::now() - before).count());
    if (controller_.player().playing()) infer_us_.Add(controller_.player().policy().infer_us());
    ++ticks_;
    if (first_tick_us_ == 0) first_tick_us_ = status.utime;
    last_tick_us_ = status.utime;
    PublishSkillStatus();
    const EndReason reason = controller_.player().status().end_reason;
    if (!said_ && reason > EndReason::kFinished) {
      std::fprintf(stderr, "intabs_control: plan ended: %s\n", Describe(reason));
      said_ = true;
    }
  }

  void DemandLife() const {
    if (started_ && MonotonicUs() - heard_us_ > kSilenceUs) {
      throw std::runtime_error("no LITE6_STATUS for 10 s: is intabs_plant or intabs_lite6 still running on " +
                               options_.lcm + "?");
    }
    if (started_ && !poses_ && MonotonicUs() - started_us_ > kSilenceUs) {
      throw std::runtime_error(options_.perception == "tags"
                                   ? "no OBJECT_POSES for 10 s: is intabs_perception running, has the plant cameras?"
                                   : "no PLANT_TRUTH for 10 s: --perception truth needs intabs_plant");
    }
  }

  void RunLockstep() {
    std::optional<ArmStatus> pending;
    int64_t answered = -1;  // seq
    int64_t asked_us = MonotonicUs();
    while (!StopRequested()) {
      if (bus_.Handle(100) < 0) throw std::runtime_error("LCM is broken on " + options_.lcm);
      DemandLife();
      ArmStatus s;
      if (status_.Take(s)) {
        if (s.seq == answered) {
          bus_.Publish(kLite6Command, command_);  // it has not arrived
        } else {
          pending = s;
        }
      }
      if (!started_ || !pending) {
        asked_us = MonotonicUs();
        continue;
      }
      if (options_.perception == "tags" && pending->last_frame_seq == 0) {
        throw std::runtime_error("the plant has no cameras: start it with --cameras, or give --perception truth");
      }
      if (!poses_ || poses_->frame_seq != pending->last_frame_seq) {
        if (MonotonicUs() - asked_us > kSilenceUs / 2) {
          throw std::runtime_error("no object poses of the plant's newest frame for 5 s: is intabs_perception running on " +
                                   options_.lcm + "? Without cameras give --perception truth");
        }
        continue;
      }
      answered = pending->seq;
      Answer(*pending, *poses_);
      pending.reset();
      PublishLoopStatusNowAndThen();
    }
  }

  void RunWall() {
    int64_t next_us = MonotonicUs();
    std::optional<ArmStatus> newest;
    while (!StopRequested()) {
      next_us += kPolicyPeriodUs;
      for (int64_t now = MonotonicUs(); now < next_us && !StopRequested(); now = MonotonicUs()) {
        if (bus_.Handle(static_cast<int>((next_us - now + 999) / 1000)) < 0)
          throw std::runtime_error("LCM is broken on " + options_.lcm);
      }
      if (const int64_t late = MonotonicUs() - next_us; late > kPolicyPeriodUs) {
        overruns_ += late / kPolicyPeriodUs;
        next_us += late / kPolicyPeriodUs * kPolicyPeriodUs;
      }
      DemandLife();
      ArmStatus s;
      if (status_.Take(s)) newest = s;
      if (!started_ || !newest || !poses_ || MonotonicUs() - heard_us_ > kStatusAgeUs) continue;
      Answer(*newest, *poses_);
      PublishLoopStatusNowAndThen();
    }
  }

  void PublishSkillStatus() {
    const PlayerStatus& p = controller_.player().status();
    SkillStatus m;
    m.utime = last_tick_us_;
    m.seq = ++skill_seq_;
    m.plan_id = p.plan_id;
    m.skill_index = p.skill_index;
    m.n_skills = p.n_skills;
    m.progress = p.progress;
    m.b_probability = p.b;
    m.infer_us = controller_.player().policy().infer_us();
    m.skill_end = static_cast<int8_t>(p.skill_end);
    m.retries = static_cast<int8_t>(p.retries);
    m.end_reason = static_cast<int8_t>(p.end_reason);
    bus_.Publish(kSkillStatus, m);
  }

  static float Float(double v) { return static_cast<float>(v); }

  double Rate() const {
    return ticks_ > 1 ? 1e6 * static_cast<double>(ticks_ - 1) / static_cast<double>(last_tick_us_ - first_tick_us_) : 0;
  }

  void PublishLoopStatusNowAndThen() {
    if (MonotonicUs() - loop_status_us_ >= 1'000'000) PublishLoopStatus();
  }
  void PublishLoopStatus() {
    loop_status_us_ = MonotonicUs();
    LoopStatus m;
    m.utime = last_tick_us_;
    m.seq = ++loop_seq_;
    m.name = "control";
    m.ticks = ticks_;
    m.overruns = overruns_;
    m.rate_hz = static_cast<float>(Rate());
    m.tick_us = {Float(tick_us_.PercentileUs(0.5)), Float(tick_us_.PercentileUs(0.99)), Float(tick_us_.max_us())};
    m.infer_us = {Float(infer_us_.PercentileUs(0.5)), Float(infer_us_.PercentileUs(0.99))};
    bus_.Publish(kLoopStatus, m);
  }

  const Options options_;
  LcmBus bus_;
  SkillController controller_;
  PlanReceiver plan_;
  Newest<ArmStatus> status_;
  std::optional<ObjectPoses> poses_;  // in the arm's base
  std::optional<Pose> X_BW_;          // unset: W is the base
  ArmCommand command_;
  bool started_ = false;
  bool said_ = false;
  int64_t heard_us_ = 0;
  int64_t started_us_ = 0;
  int64_t source_ = 0;
  int64_t ticks_ = 0, overruns_ = 0, first_tick_us_ = 0, last_tick_us_ = 0;
  int64_t skill_seq_ = 0, loop_seq_ = 0, loop_status_us_ = 0;
  TickStats tick_us_, infer_us_;
};

int Main(int argc, char** argv) {
  Options o;
  CLI::App app{"Plays skill plans: LITE6_STATUS and OBJECT_POSES in, LITE6_COMMAND out, 25 Hz."};
  AddYamlConfig(app);
  app.add_option("--lcm", o.lcm, "LCM URL")->capture_default_str();
  app.add_option("--prefix", o.prefix, "comes before every channel's name");
  app.add_option("--weights", o.weights, "weights folder")->capture_default_str();
  app.add_option("--perception", o.perception, "where object poses come from")
      ->check(CLI::IsMember({"tags", "truth"}))
      ->capture_default_str();
  app.add_option("--clock", o.clock, "lockstep or wall, as the plant; a real arm: wall")
      ->check(CLI::IsMember({"lockstep", "wall"}))
      ->capture_default_str();
  app.add_option("--hand-eye", o.hand_eye,
                 "YAML with X_WB, the arm base in W: what tools/calibrate hand-eye wrote, or the configuration of "
                 "intabs_perception; none: W is the base, as in the plant");
  app.add_option("--json", o.json, "write the figures there at the end");
  if (const auto code = ParseCommandLine(app, "intabs_control", argc, argv)) return *code;
  InstallStopSignals();
  try {
    Control control(o);
    control.Run();
    if (!o.json.empty()) control.WriteJson(o.json);
  } catch (const std::exception& e) {
    std::cerr << "intabs_control: " << e.what() << "\n";
    return 1;
  }
  return 0;
}

}  // namespace
}  // namespace intabs

int main(int argc, char** argv) { return intabs::Main(argc, argv); }
