// intabs_perception: camera frames -> tag poses -> one fused pose an object.
#include <CLI/CLI.hpp>
#include <iostream>
#include <opencv2/core/utility.hpp>

#include "intabs/rt/stop_signal.h"
#include "frames.h"
#include "live.h"

namespace intabs {
namespace {

int Main(int argc, char** argv) {
  LiveOptions live;
  FramesOptions frames;
  CLI::App app{
      "Object poses from camera frames: frames of a plant's ring in; OBJECT_POSES, TAG_DETECTIONS_*, "
      "PERCEPTION_STATUS out. With --frames: the frames of a folder."};
  app.add_option("--lcm", live.lcm, "LCM URL")->capture_default_str();
  app.add_option("--prefix", live.prefix, "comes before every channel's name");
  app.add_option("--ring", live.ring, "name of the frames' shared memory")->capture_default_str();
  app.add_option("--config", live.config, "YAML file: cameras, ground tag, objects and their tags")
      ->capture_default_str();
  app.add_option("--json", live.json, "write the figures there at the end");
  auto* dir = app.add_option("--frames", frames.dir, "solve the frames of this folder's frames.json instead");
  auto* result = app.add_option("--result", frames.result, "where their poses go")->needs(dir);
  dir->needs(result);
  app.add_flag("--single", frames.single, "the first camera alone")->needs(dir);
  app.add_flag("--independent", frames.independent, "the frames have nothing to do with each other")
      ->needs(dir);
  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& e) {
    if (e.get_exit_code() == 0) return app.exit(e);
    std::cerr << "intabs_perception: " << e.what() << " (see --help)\n";
    return 1;
  }
  InstallStopSignals();
  cv::setNumThreads(1);
  try {
    if (!frames.dir.empty()) {
      frames.json = live.json;
      SolveFrames(frames);
      return 0;
    }
    Live process(live);
    process.Run();
    process.WriteJson();
  } catch (const std::exception& e) {
    std::cerr << "intabs_perception: " << e.what() << "\n";
    return 1;
  }
  return 0;
}

}  // namespace
}  // namespace intabs

int main(int argc, char** argv) { return intabs::Main(argc, argv); }
