// intabs_plant: MuJoCo behind the channels of the arm.
#include <CLI/CLI.hpp>
#include <algorithm>
#include <iostream>
#include <string>

#include "../common/yaml_config.h"
#include "intabs/rt/stop_signal.h"
#include "options.h"
#include "plant.h"

namespace intabs {
namespace {

int Main(int argc, char** argv) {
  PlantOptions o;
  CLI::App app{
      "The simulated arm with its table and cameras: LITE6_COMMAND in; LITE6_STATUS, PLANT_TRUTH and frames "
      "out."};
  AddYamlConfig(app);
  app.add_option("--task", o.task, "what stands on the table and what counts as success")
      ->capture_default_str();
  app.add_option("--seed", o.seed, "where the objects stand")->capture_default_str();
  app.add_option("--spread", o.spread, "how far from their nominal places at most, cm")
      ->check(CLI::Range(0.0, World::kMaxSpread))
      ->capture_default_str();
  app.add_option("--clock", o.clock, "lockstep: simulation waits for each command; wall: nobody waits")
      ->check(CLI::IsMember({"lockstep", "wall"}))
      ->capture_default_str();
  app.add_option("--lcm", o.lcm, "LCM URL")->capture_default_str();
  app.add_option("--prefix", o.prefix, "comes before every channel's name");
  app.add_option("--models", o.models, "folder with scenes, objects and the arm")->capture_default_str();
  app.add_flag("--cameras,!--no-cameras", o.cameras, "write camera frames into the ring (default)");
  app.add_option("--ring", o.ring, "name of the frames' shared memory")->capture_default_str();
  app.add_option("--video", o.video, "write a video, FILE.mp4");
  app.add_option("--strip", o.strip, "write a strip of pictures of the run, FILE.png");
  app.add_flag("--viewer", o.viewer, "open a window");
  app.add_option("--json", o.json, "write the figures there at the end");
  if (const auto code = ParseCommandLine(app, "intabs_plant", argc, argv)) return *code;
  InstallStopSignals();
  try {
    Plant plant(o);
    plant.Run();
  } catch (const std::exception& e) {
    std::string line = e.what();  // MuJoCo speaks in several
    std::replace(line.begin(), line.end(), '\n', ' ');
    std::cerr << "intabs_plant: " << line << "\n";
    return 1;
  }
  return 0;
}

}  // namespace
}  // namespace intabs

int main(int argc, char** argv) { return intabs::Main(argc, argv); }
