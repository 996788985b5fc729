// What perception knows beforehand: cameras, the ground tag, and which tags sit where on which object. Read
// from one YAML file; what calibration finds (tools/calibrate) may stand in a file of its own.
#pragma once

#include <array>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "intabs/perception/camera_model.h"

namespace intabs {

struct GroundTag {  // defines W
  int id = 0;
  double size = 0;  // black edge [m]
  Pose X_WT;
};

struct ObjectTag {
  int id = 0;
  double size = 0;  // black edge [m]
  Pose X_OT;
};

struct ObjectModel {
  int slot = 0;  // of ObjectPoses; several objects may name one, of which a scene holds one at most
  int id = 0;    // unique
  std::string name;
  std::vector<ObjectTag> tags;
};

struct PerceptionConfig {
  std::vector<CameraModel> cameras;  // at most kMaxCameras
  std::optional<GroundTag> ground;   // needed unless every camera has its X_WC
  std::vector<ObjectModel> objects;
  Pose X_WB;                      // arm base in W (hand-eye); identity: W is the base, as in the plant
  double corner_sigma_px = 0.05;  // standard deviation of a tag corner's coordinate
};

// The keys of the file. Options of intabs_perception may stand in it too; they are not looked at here.
inline constexpr std::array kConfigKeys = {"cameras", "ground",   "objects",    "corner_sigma_px",
                                           "X_WB",    "hand_eye", "calibration"};
inline constexpr std::array kProgramKeys = {"lcm", "prefix", "ring", "json", "threads", "hands"};

// Throws std::runtime_error that names the field and its value: no camera, a tag or id used twice, sizes <=
// 0, ...
void Check(const PerceptionConfig& config);

// Reads and checks a file like models/config/perception.yaml. Throws std::runtime_error "FILE: what is
// wrong". `calibration: FILE` (seen from that file) takes cameras and X_WB from there.
PerceptionConfig LoadPerceptionConfig(const std::string& path);

// How something was found, for people: key and value (a number, or a text that needs no quotes).
using Notes = std::vector<std::pair<std::string, std::string>>;

// What tools/calibrate finds: the keys `cameras`, `X_WB` and `hand_eye` of the same format, with notes beside
// them that LoadPerceptionConfig passes over.
struct Calibration {
  struct Camera {
    CameraModel model;
    Notes intrinsics, extrinsics;
  };
  std::vector<Camera> cameras;
  std::optional<Pose> X_WB;
  Notes hand_eye;
};

// Throw std::runtime_error "FILE: what is wrong".
Calibration LoadCalibration(const std::string& path);
void SaveCalibration(const std::string& path, const Calibration& calibration);  // replaces the file at once

}  // namespace intabs
