// intabs_perception: camera frames -> tag poses -> one fused pose an object.
#include <CLI/CLI.hpp>
#include <iostream>
#include <opencv2/core/utility.hpp>

#include "../common/yaml_config.h"
#include "frames.h"
#include "intabs/rt/stop_signal.h"
#include "live.h"

namespace intabs {
namespace {

int Main(int argc, char** argv) {
  LiveOptions live;
  FramesOptions frames;
  CLI::App app{
      "Object poses from camera frames: frames of a plant's ring, or of cameras, in; OBJECT_POSES, "
      "TAG_DETECTIONS_*, PERCEPTION_STATUS out, with --hands HAND_POINTS_* too. With --frames: the frames of a "
      "folder."};
  AddYamlConfig(app, live.config, {kConfigKeys.begin(), kConfigKeys.end()},
                "YAML file: cameras, ground tag, objects and their tags; options too");
  app.add_option("--lcm", live.lcm, "LCM URL")->capture_default_str();
  app.add_option("--prefix", live.prefix, "comes before every channel's name");
  app.add_option("--ring", live.ring, "name of the plant's frames in shared memory")->capture_default_str();
  app.add_option("--source", live.sources,
                 "CAMERA=KIND:WHERE, once a camera, instead of the plant's ring: ring:/NAME, v4l2:DEVICE, "
                 "realsense:SERIAL, folder:DIR, video:FILE; also as `source` of a camera in the YAML file")
      ->allow_extra_args(false);
  app.add_option("--threads", live.threads, "of the tag detector")
      ->capture_default_str()
      ->check(CLI::Range(1, 64));
  app.add_flag("--hands", live.hands,
               "points of hands in space too: HAND_KEYPOINTS_<camera> in, HAND_POINTS_<camera> out, where "
               "the source has depth");
  app.add_option("--json", live.json, "write the figures there at the end");
  auto* dir = app.add_option("--frames", frames.dir, "solve the frames of this folder's frames.json instead");
  auto* result = app.add_option("--result", frames.result, "where their poses go")->needs(dir);
  dir->needs(result);
  app.add_flag("--single", frames.single, "the first camera alone")->needs(dir);
  app.add_flag("--independent", frames.independent, "the frames have nothing to do with each other")
      ->needs(dir);
  app.add_flag("--offline", frames.offline, "poses are chosen by the frames after them too")->needs(dir);
  app.add_option(
         "--extrinsic-sigma", frames.extrinsic_sigma,
         "MM,DEG: how well the cameras' places beside the first one's are known, one standard deviation of "
         "each axis; default: exactly")
      ->delimiter(',')
      ->expected(2)
      ->check(CLI::PositiveNumber)
      ->needs(dir);
  if (const auto code = ParseCommandLine(app, "intabs_perception", argc, argv)) return *code;
  live.config = app.get_config_ptr()->as<std::string>();
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
