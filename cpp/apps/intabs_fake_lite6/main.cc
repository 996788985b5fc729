// intabs_fake_lite6: a Lite 6 controller to test against, with nothing, or a MuJoCo world, behind it.
#include <pthread.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <memory>
#include <string>

#include "../common/yaml_config.h"
#include "../intabs_plant/options.h"
#include "../intabs_plant/view.h"
#include "intabs/bus/lcm_bus.h"
#include "intabs/lite6/fake.h"
#include "intabs/rt/periodic.h"
#include "intabs/rt/stop_signal.h"
#include "intabs/sim/arm_sim.h"

namespace intabs {
namespace {

using lite6::FakeArm;
using lite6::FakeController;
using lite6::FakeOptions;

constexpr int kPriority = 77;  // below the driver's threads

struct Options {
  FakeOptions fake;
  bool plant = false;
  PlantOptions world;  // with --plant
  std::string json;
};

// The world that the fake arm moves: what intabs_plant shows, but for the arm's own channels. Those belong to whoever
// drives the controller.
class WorldBody {
 public:
  explicit WorldBody(const PlantOptions& options)
      : options_(options), bus_(options.lcm, options.prefix), world_(options.models, options.task) {
    world_.Reset(options.seed, options.spread);
    view_ = View::Make(world_, options_);
  }

  void Tick(FakeArm& arm) {
    world_.Step({arm.q_ref(), arm.dq_ref(), arm.gripper_closed()});
    const ArmMeasurement m = world_.Arm();
    arm.Measure(m.q, m.dq, m.tau);
    if (++ticks_ % (kPolicyPeriodUs / kDriverPeriodUs) != 0) return;
    ++frame_seq_;
    const int64_t now_us = MonotonicUs();
    if (view_) view_->Look(world_, frame_seq_, now_us);
    PlantTruth truth;
    FillTruth(world_, truth);
    truth.utime = now_us;
    truth.seq = truth.frame_seq = frame_seq_;
    bus_.Publish(kPlantTruth, truth);
  }

  void Close() {
    if (view_) view_->Close();
  }

 private:
  const PlantOptions options_;
  LcmBus bus_;
  World world_;
  std::unique_ptr<View> view_;
  int64_t ticks_ = 0, frame_seq_ = 0;
};

void Run(const Options& o) {
  std::unique_ptr<WorldBody> body;
  FakeController::Body tick;
  if (o.plant) {
    body = std::make_unique<WorldBody>(o.world);
    tick = [&body](FakeArm& arm) { body->Tick(arm); };
  }
  FakeController fake(o.fake, World::Home(), tick);
  std::fprintf(stderr, "controller on 127.0.0.1:%d, reports from %d\n", fake.port(), fake.report_port_base());
  // A real controller does not wait for our CPUs; where this is not allowed, the fake may. Only this thread: pictures
  // take what is left.
  sched_param priority{};
  priority.sched_priority = kPriority;
  (void)pthread_setschedparam(pthread_self(), SCHED_FIFO, &priority);
  fake.Run(StopRequested);
  if (body) body->Close();
  if (o.json.empty()) return;
  std::ofstream out(o.json);
  out << fake.Order("state") << "\n";
  if (!out) throw std::runtime_error("cannot write " + o.json);
}

int Main(int argc, char** argv) {
  Options o;
  o.world.clock = "wall";
  CLI::App app{
      "A Lite 6 controller to test against, on 127.0.0.1: the vendor's protocol, and faults to order. With --plant the "
      "arm moves a MuJoCo world, whose cameras and PLANT_TRUTH are those of intabs_plant."};
  AddYamlConfig(app);
  const auto port = CLI::Range(0, 65532);
  app.add_option("--port", o.fake.port, "control port; 0: any free one")->check(port)->capture_default_str();
  app.add_option("--report-port-base", o.fake.report_port_base, "reports at N .. N+3, as 30000 .. 30003; 0: any free ones")
      ->check(port)
      ->capture_default_str();
  app.add_option("--orders-port", o.fake.orders_port,
                 "takes orders as lines of text, such as \"delay 200\", \"drop\", \"state\"; any other line lists them")
      ->check(CLI::Range(0, 65535));
  app.add_option("--heartbeat", o.fake.heartbeat_s, "s of silence until a client is given up; 0: never")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  app.add_option("--delay-every", o.fake.delay_every_s, "every so many s answer nothing for a while")
      ->check(CLI::NonNegativeNumber);
  app.add_option("--delay-ms", o.fake.delay_ms, "that while")->check(CLI::Range(1, 100000))->capture_default_str();
  app.add_option("--drop-every", o.fake.drop_every_s, "every so many s close all connections")
      ->check(CLI::NonNegativeNumber);
  app.add_option("--corrupt-every", o.fake.corrupt_every_s, "every so many s damage a report")
      ->check(CLI::NonNegativeNumber);
  app.add_flag("--plant", o.plant, "a MuJoCo world behind the arm");
  app.add_option("--task", o.world.task, "what stands on the table")->capture_default_str();
  app.add_option("--seed", o.world.seed, "where the objects stand")->capture_default_str();
  app.add_option("--spread", o.world.spread, "how far from their nominal places at most, cm")
      ->check(CLI::Range(0.0, World::kMaxSpread))
      ->capture_default_str();
  app.add_option("--lcm", o.world.lcm, "LCM URL of PLANT_TRUTH")->capture_default_str();
  app.add_option("--prefix", o.world.prefix, "comes before the channel's name");
  app.add_option("--models", o.world.models, "folder with scenes, objects and the arm")->capture_default_str();
  app.add_flag("--cameras,!--no-cameras", o.world.cameras, "write camera frames into the ring (default)");
  app.add_option("--ring", o.world.ring, "name of the frames' shared memory")->capture_default_str();
  app.add_option("--video", o.world.video, "write a video, FILE.mp4");
  app.add_option("--strip", o.world.strip, "write a strip of pictures of the run, FILE.png");
  app.add_flag("--viewer", o.world.viewer, "open a window");
  app.add_option("--json", o.json, "write the figures there at the end");
  if (const auto code = ParseCommandLine(app, "intabs_fake_lite6", argc, argv)) return *code;
  InstallStopSignals();
  try {
    Run(o);
  } catch (const std::exception& e) {
    std::string line = e.what();  // MuJoCo speaks in several
    std::replace(line.begin(), line.end(), '\n', ' ');
    std::cerr << "intabs_fake_lite6: " << line << "\n";
    return 1;
  }
  return 0;
}

}  // namespace
}  // namespace intabs

int main(int argc, char** argv) { return intabs::Main(argc, argv); }
