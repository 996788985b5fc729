#include "intabs/perception/config.h"

#include <algorithm>
#include <array>
#include <cerrno>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <limits>
#include <set>
#include <span>
#include <sstream>
#include <stdexcept>
#include <vector>

#include "intabs/core/types.h"
#include "intabs/perception/yaml.h"

namespace intabs {
namespace {

[[noreturn]] void Fail(const std::string& what) { throw std::runtime_error(OneLine(what)); }

// Whether a key has a value.
bool Given(const YAML::Node& node) { return node && !node.IsNull(); }

// Every map says which keys it has: a misspelt key is an error, not a silent default.
void AllowOnly(const YAML::Node& map, const std::string& where, const std::vector<const char*>& keys) {
  if (!map.IsMap()) Fail(where + ": expected a map of values");
  std::set<std::string> seen;
  for (const auto& entry : map) {
    const std::string key = entry.first.IsScalar() ? entry.first.Scalar() : "?";
    if (std::none_of(keys.begin(), keys.end(), [&](const char* k) { return key == k; })) {
      Fail(where + ": unknown key \"" + key + "\"");
    }
    if (!seen.insert(key).second) Fail(where + ": \"" + key + "\" is given twice");
  }
}

YAML::Node Get(const YAML::Node& map, const std::string& where, const char* key) {
  const YAML::Node node = map[key];
  if (!Given(node)) Fail(where + ": \"" + key + "\" is missing");
  return node;
}

bool Quoted(const YAML::Node& scalar) { return scalar.Tag() == "!"; }

double Number(const YAML::Node& node, const std::string& where) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const double v = node.IsScalar() && !Quoted(node) ? node.as<double>(nan) : nan;
  if (!std::isfinite(v)) Fail(where + ": expected a number");
  return v;
}

int Integer(const YAML::Node& node, const std::string& where) {
  int v = 0;
  if (!node.IsScalar() || Quoted(node) || !YAML::convert<int>::decode(node, v)) Fail(where + ": expected a whole number");
  return v;
}

std::string Text(const YAML::Node& node, const std::string& where) {
  if (!node.IsScalar()) Fail(where + ": expected a text");
  return node.Scalar();
}

template <size_t N>
std::array<double, N> Numbers(const YAML::Node& node, const std::string& where) {
  if (!node.IsSequence() || node.size() != N) Fail(where + ": expected " + std::to_string(N) + " numbers");
  std::array<double, N> out;
  for (size_t i = 0; i < N; ++i) out[i] = Number(node[i], where);
  return out;
}

Pose ReadPose(const YAML::Node& node, const std::string& where) {
  AllowOnly(node, where, {"p", "q"});
  const auto p = Numbers<3>(Get(node, where, "p"), where + ".p");
  const auto q = Numbers<4>(Get(node, where, "q"), where + ".q");
  const Eigen::Quaterniond rotation(q[0], q[1], q[2], q[3]);
  if (!(std::abs(rotation.norm() - 1) < 1e-3)) {
    Fail(where + ".q: the norm of (w x y z) is " + std::to_string(rotation.norm()) + ", not 1");
  }
  return {{p[0], p[1], p[2]}, rotation.normalized()};
}

// A number in the fewest digits that give the same one again.
std::string Shortest(double v) {
  char text[32];
  return {text, std::to_chars(text, text + sizeof(text), v).ptr};
}

// Lists of what a sequence holds; a lone value is no list.
YAML::Node Sequence(const YAML::Node& node, const std::string& where) {
  if (!node.IsSequence()) Fail(where + ": expected a list");
  return node;
}

Notes ReadNotes(const YAML::Node& node, const std::string& where) {
  Notes notes;
  if (!Given(node)) return notes;
  if (!node.IsMap()) Fail(where + ": expected a map of values");
  for (const auto& entry : node) {
    const std::string key = Text(entry.first, where);
    notes.emplace_back(key, Text(entry.second, where + "." + key));
  }
  return notes;
}

std::vector<Calibration::Camera> ReadCameras(const YAML::Node& list) {
  std::vector<Calibration::Camera> cameras;
  for (const YAML::Node& node : Sequence(list, "cameras")) {
    const std::string at = "cameras[" + std::to_string(cameras.size()) + "]";
    AllowOnly(node, at,
              {"name", "width", "height", "fx", "fy", "cx", "cy", "distortion", "X_WC", "source",
               "intrinsics", "extrinsics"});
    Calibration::Camera& camera = cameras.emplace_back();
    CameraModel& m = camera.model;
    m.name = Text(Get(node, at, "name"), at + ".name");
    m.width = Integer(Get(node, at, "width"), at + ".width");
    m.height = Integer(Get(node, at, "height"), at + ".height");
    m.fx = Number(Get(node, at, "fx"), at + ".fx");
    m.fy = Number(Get(node, at, "fy"), at + ".fy");
    m.cx = Number(Get(node, at, "cx"), at + ".cx");
    m.cy = Number(Get(node, at, "cy"), at + ".cy");
    if (Given(node["distortion"])) m.distortion = Numbers<5>(node["distortion"], at + ".distortion");
    if (Given(node["X_WC"])) m.X_WC = ReadPose(node["X_WC"], at + ".X_WC");
    if (Given(node["source"])) m.source = Text(node["source"], at + ".source");
    camera.intrinsics = ReadNotes(node["intrinsics"], at + ".intrinsics");
    camera.extrinsics = ReadNotes(node["extrinsics"], at + ".extrinsics");
  }
  return cameras;
}

Calibration ReadCalibration(const YAML::Node& root) {
  AllowOnly(root, "top level", {"cameras", "X_WB", "hand_eye"});
  Calibration calibration;
  if (Given(root["cameras"])) calibration.cameras = ReadCameras(root["cameras"]);
  if (Given(root["X_WB"])) calibration.X_WB = ReadPose(root["X_WB"], "X_WB");
  calibration.hand_eye = ReadNotes(root["hand_eye"], "hand_eye");
  return calibration;
}

// `folder`: of the file, with a slash at its end.
PerceptionConfig Read(const YAML::Node& root, const std::string& folder) {
  PerceptionConfig config;
  std::vector<const char*> keys(kConfigKeys.begin(), kConfigKeys.end());
  keys.insert(keys.end(), kProgramKeys.begin(), kProgramKeys.end());
  AllowOnly(root, "top level", keys);
  if (Given(root["corner_sigma_px"]))
    config.corner_sigma_px = Number(root["corner_sigma_px"], "corner_sigma_px");

  Calibration calibration;
  if (const YAML::Node file = root["calibration"]; Given(file)) {
    if (Given(root["cameras"]) || Given(root["X_WB"]))
      Fail("calibration: its file gives cameras and X_WB; take them out here");
    const std::string name = Text(file, "calibration");
    calibration = LoadCalibration(name.starts_with('/') ? name : folder + name);
  } else {
    calibration.cameras = ReadCameras(Get(root, "top level", "cameras"));
    if (Given(root["X_WB"])) calibration.X_WB = ReadPose(root["X_WB"], "X_WB");
  }
  for (const Calibration::Camera& c : calibration.cameras) config.cameras.push_back(c.model);
  config.X_WB = calibration.X_WB.value_or(Pose{});

  if (const YAML::Node node = root["ground"]; Given(node)) {
    AllowOnly(node, "ground", {"id", "size", "X_WT"});
    config.ground = GroundTag{Integer(Get(node, "ground", "id"), "ground.id"),
                              Number(Get(node, "ground", "size"), "ground.size"),
                              ReadPose(Get(node, "ground", "X_WT"), "ground.X_WT")};
  }

  for (const YAML::Node& node : Sequence(Get(root, "top level", "objects"), "objects")) {
    const std::string at = "objects[" + std::to_string(config.objects.size()) + "]";
    AllowOnly(node, at, {"slot", "id", "name", "tags"});
    ObjectModel object;
    object.slot = Integer(Get(node, at, "slot"), at + ".slot");
    object.id = Integer(Get(node, at, "id"), at + ".id");
    object.name = Text(Get(node, at, "name"), at + ".name");
    for (const YAML::Node& tag : Sequence(Get(node, at, "tags"), at + ".tags")) {
      const std::string tag_at = at + ".tags[" + std::to_string(object.tags.size()) + "]";
      AllowOnly(tag, tag_at, {"id", "size", "X_OT"});
      object.tags.push_back({Integer(Get(tag, tag_at, "id"), tag_at + ".id"),
                             Number(Get(tag, tag_at, "size"), tag_at + ".size"),
                             ReadPose(Get(tag, tag_at, "X_OT"), tag_at + ".X_OT")});
    }
    config.objects.push_back(object);
  }
  return config;
}

// Whether pixels of the picture can be traced back through the distortion.
bool Unfolds(const CameraModel& camera) {
  for (const double x : {0.0, 0.5, 1.0}) {
    for (const double y : {0.0, 0.5, 1.0}) {
      const Eigen::Vector2d uv(x * camera.width, y * camera.height);
      if (!((camera.Distort(camera.Undistort(uv)) - uv).norm() < 0.01)) return false;
    }
  }
  return true;
}

}  // namespace

void Check(const PerceptionConfig& config) {
  if (config.cameras.empty() || config.cameras.size() > kMaxCameras) {
    Fail("cameras: " + std::to_string(config.cameras.size()) + " are given, use 1 to " +
         std::to_string(kMaxCameras));
  }
  for (const CameraModel& c : config.cameras) {
    if (c.width < 16 || c.height < 16) {
      Fail("camera " + c.name + ": " + std::to_string(c.width) + " x " + std::to_string(c.height) +
           " px is no image size");
    }
    if (!(c.fx > 0 && c.fy > 0 && std::isfinite(c.cx) && std::isfinite(c.cy))) {
      Fail("camera " + c.name + ": fx, fy must be > 0 and cx, cy finite");
    }
    if (!Unfolds(c)) {
      Fail("camera " + c.name +
           ": the distortion cannot be undone at the edges of its picture: calibrate anew");
    }
    if (!c.X_WC && !config.ground) {
      Fail("camera " + c.name + ": neither X_WC nor a ground tag says where it stands; give one");
    }
  }
  std::set<int> tags, ids;
  const auto check_tag = [&](int id, double size) {
    if (id < 0 || id > 586) Fail("tag " + std::to_string(id) + ": tag36h11 has ids 0 to 586");
    if (!(size > 0)) Fail("tag " + std::to_string(id) + ": size " + std::to_string(size) + " m, must be > 0");
    if (!tags.insert(id).second) Fail("tag " + std::to_string(id) + " is used twice");
  };
  if (config.ground) check_tag(config.ground->id, config.ground->size);
  for (const ObjectModel& o : config.objects) {
    if (o.slot < 0 || o.slot >= kMaxObjects) {
      Fail("object " + o.name + ": slot " + std::to_string(o.slot) + ", must be 0 to " +
           std::to_string(kMaxObjects - 1));
    }
    if (o.id < 0 || !ids.insert(o.id).second) {
      Fail("object " + o.name + ": id " + std::to_string(o.id) + " is taken or below 0");
    }
    if (o.tags.empty()) Fail("object " + o.name + " has no tags");
    for (const ObjectTag& t : o.tags) check_tag(t.id, t.size);
  }
  if (!(config.corner_sigma_px > 0)) {
    Fail("corner_sigma_px: " + std::to_string(config.corner_sigma_px) + ", must be > 0");
  }
}

namespace {

// read(root, folder of the file).
template <class F>
auto Load(const std::string& path, const F& read) {
  const YAML::Node root = LoadYaml(path);
  try {
    return read(root, path.substr(0, path.rfind('/') + 1));
  } catch (const std::exception& e) {
    Fail(path + ": " + e.what());
  }
}

std::string Flow(const Notes& notes) {
  std::string out;
  for (const auto& [key, value] : notes) {
    const bool number = !value.empty() && value.find_first_not_of("0123456789.-+e") == std::string::npos &&
                        value.find('-', 1) == std::string::npos;
    out += (out.empty() ? "" : ", ") + key + ": " + (number ? value : '"' + value + '"');
  }
  return "{" + out + "}";
}

std::string Flow(std::span<const double> values) {
  std::string out;
  for (const double v : values) out += (out.empty() ? "" : ", ") + Shortest(v);
  return "[" + out + "]";
}

std::string Flow(const Pose& X) {
  const std::array<double, 4> q{X.q.w(), X.q.x(), X.q.y(), X.q.z()};
  return "{p: " + Flow(std::span(X.p.data(), 3)) + ", q: " + Flow(q) + "}";
}

}  // namespace

PerceptionConfig LoadPerceptionConfig(const std::string& path) {
  return Load(path, [](const YAML::Node& root, const std::string& folder) {
    PerceptionConfig config = Read(root, folder);
    Check(config);
    return config;
  });
}

Calibration LoadCalibration(const std::string& path) {
  return Load(path, [](const YAML::Node& root, const std::string&) { return ReadCalibration(root); });
}

void SaveCalibration(const std::string& path, const Calibration& calibration) {
  std::ostringstream out;
  out << "# Written by tools/calibrate. `calibration: FILE` in a configuration of intabs_perception takes "
         "it.\n"
         "# Lengths in m, quaternions (w, x, y, z), distortion k1 k2 p1 p2 k3.\n";
  if (!calibration.cameras.empty()) out << "cameras:\n";
  for (const auto& [m, intrinsics, extrinsics] : calibration.cameras) {
    out << "  - name: " << m.name << "\n    width: " << m.width << "\n    height: " << m.height
        << "\n    fx: " << Shortest(m.fx) << "\n    fy: " << Shortest(m.fy) << "\n    cx: " << Shortest(m.cx)
        << "\n    cy: " << Shortest(m.cy) << "\n";
    if (m.distorted()) out << "    distortion: " << Flow(m.distortion) << "\n";
    if (m.X_WC) out << "    X_WC: " << Flow(*m.X_WC) << "\n";
    if (!m.source.empty()) out << "    source: \"" << m.source << "\"\n";
    if (!intrinsics.empty()) out << "    intrinsics: " << Flow(intrinsics) << "\n";
    if (!extrinsics.empty()) out << "    extrinsics: " << Flow(extrinsics) << "\n";
  }
  if (calibration.X_WB) out << "X_WB: " << Flow(*calibration.X_WB) << "\n";
  if (!calibration.hand_eye.empty()) out << "hand_eye: " << Flow(calibration.hand_eye) << "\n";
  const std::string part = path + ".partial";
  std::ofstream file(part);
  file << out.str();
  file.close();
  if (!file || std::rename(part.c_str(), path.c_str()) != 0)
    Fail(path + ": cannot be written: " + std::strerror(errno));
}

}  // namespace intabs
