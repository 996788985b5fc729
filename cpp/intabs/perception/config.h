// What perception knows beforehand: cameras, the ground tag, and which tags sit where on which object.
#pragma once

#include <optional>
#include <string>
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
  int slot = 0;  // of ObjectPoses
  int id = 0;
  std::string name;
  std::vector<ObjectTag> tags;
};

struct PerceptionConfig {
  std::vector<CameraModel> cameras;  // at most kMaxCameras
  std::optional<GroundTag> ground;   // needed unless every camera has its X_WC
  std::vector<ObjectModel> objects;
  double corner_sigma_px = 0.05;  // standard deviation of a tag corner's coordinate
};

// Throws std::runtime_error that names the field and its value: no camera, a tag or slot used twice, sizes <=
// 0, ...
void Check(const PerceptionConfig& config);

// Reads and checks a file like models/config/perception.yaml. Throws std::runtime_error "FILE: what is
// wrong". Read by OpenCV's own YAML reader, so that processes, bindings and tests share one loader without
// another library.
PerceptionConfig LoadPerceptionConfig(const std::string& path);

}  // namespace intabs
