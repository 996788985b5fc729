#include "intabs/perception/config.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <fstream>
#include <initializer_list>
#include <opencv2/core.hpp>
#include <set>
#include <sstream>
#include <stdexcept>

#include "intabs/core/types.h"

namespace intabs {
namespace {

[[noreturn]] void Fail(const std::string& what) { throw std::runtime_error(what); }

// Every map says which keys it has: a misspelt key is an error, not a silent default.
void AllowOnly(const cv::FileNode& map, const std::string& where, std::initializer_list<const char*> keys) {
  if (!map.isMap()) Fail(where + ": expected a map of values");
  for (const std::string& key : map.keys()) {
    if (std::none_of(keys.begin(), keys.end(), [&](const char* k) { return key == k; })) {
      Fail(where + ": unknown key \"" + key + "\"");
    }
  }
}

cv::FileNode Get(const cv::FileNode& map, const std::string& where, const char* key) {
  const cv::FileNode node = map[key];
  if (node.empty()) Fail(where + ": \"" + key + "\" is missing");
  return node;
}

double Number(const cv::FileNode& node, const std::string& where) {
  if (!node.isInt() && !node.isReal()) Fail(where + ": expected a number");
  return static_cast<double>(node);
}

int Integer(const cv::FileNode& node, const std::string& where) {
  if (!node.isInt()) Fail(where + ": expected a whole number");
  return static_cast<int>(node);
}

std::string Text(const cv::FileNode& node, const std::string& where) {
  if (!node.isString()) Fail(where + ": expected a text");
  return static_cast<std::string>(node);
}

template <size_t N>
std::array<double, N> Numbers(const cv::FileNode& node, const std::string& where) {
  if (!node.isSeq() || node.size() != N) Fail(where + ": expected " + std::to_string(N) + " numbers");
  std::array<double, N> out;
  for (size_t i = 0; i < N; ++i) out[i] = Number(node[static_cast<int>(i)], where);
  return out;
}

Pose ReadPose(const cv::FileNode& node, const std::string& where) {
  AllowOnly(node, where, {"p", "q"});
  const auto p = Numbers<3>(Get(node, where, "p"), where + ".p");
  const auto q = Numbers<4>(Get(node, where, "q"), where + ".q");
  const Eigen::Quaterniond rotation(q[0], q[1], q[2], q[3]);
  if (!(std::abs(rotation.norm() - 1) < 1e-3)) {
    Fail(where + ".q: the norm of (w x y z) is " + std::to_string(rotation.norm()) + ", not 1");
  }
  return {{p[0], p[1], p[2]}, rotation.normalized()};
}

PerceptionConfig Read(const cv::FileNode& root) {
  PerceptionConfig config;
  AllowOnly(root, "top level", {"cameras", "ground", "objects", "corner_sigma_px"});
  if (!root["corner_sigma_px"].empty())
    config.corner_sigma_px = Number(root["corner_sigma_px"], "corner_sigma_px");

  for (const cv::FileNode& node : Get(root, "top level", "cameras")) {
    const std::string at = "cameras[" + std::to_string(config.cameras.size()) + "]";
    AllowOnly(node, at, {"name", "width", "height", "fx", "fy", "cx", "cy", "X_WC"});
    CameraModel camera;
    camera.name = Text(Get(node, at, "name"), at + ".name");
    camera.width = Integer(Get(node, at, "width"), at + ".width");
    camera.height = Integer(Get(node, at, "height"), at + ".height");
    camera.fx = Number(Get(node, at, "fx"), at + ".fx");
    camera.fy = Number(Get(node, at, "fy"), at + ".fy");
    camera.cx = Number(Get(node, at, "cx"), at + ".cx");
    camera.cy = Number(Get(node, at, "cy"), at + ".cy");
    if (!node["X_WC"].empty()) camera.X_WC = ReadPose(node["X_WC"], at + ".X_WC");
    config.cameras.push_back(camera);
  }

  if (const cv::FileNode node = root["ground"]; !node.empty()) {
    AllowOnly(node, "ground", {"id", "size", "X_WT"});
    config.ground = GroundTag{Integer(Get(node, "ground", "id"), "ground.id"),
                              Number(Get(node, "ground", "size"), "ground.size"),
                              ReadPose(Get(node, "ground", "X_WT"), "ground.X_WT")};
  }

  for (const cv::FileNode& node : Get(root, "top level", "objects")) {
    const std::string at = "objects[" + std::to_string(config.objects.size()) + "]";
    AllowOnly(node, at, {"slot", "id", "name", "tags"});
    ObjectModel object;
    object.slot = Integer(Get(node, at, "slot"), at + ".slot");
    object.id = Integer(Get(node, at, "id"), at + ".id");
    object.name = Text(Get(node, at, "name"), at + ".name");
    for (const cv::FileNode& tag : Get(node, at, "tags")) {
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
    if (!c.X_WC && !config.ground) {
      Fail("camera " + c.name + ": neither X_WC nor a ground tag says where it stands; give one");
    }
  }
  std::set<int> tags, slots;
  const auto check_tag = [&](int id, double size) {
    if (id < 0 || id > 586) Fail("tag " + std::to_string(id) + ": tag36h11 has ids 0 to 586");
    if (!(size > 0)) Fail("tag " + std::to_string(id) + ": size " + std::to_string(size) + " m, must be > 0");
    if (!tags.insert(id).second) Fail("tag " + std::to_string(id) + " is used twice");
  };
  if (config.ground) check_tag(config.ground->id, config.ground->size);
  for (const ObjectModel& o : config.objects) {
    if (o.slot < 0 || o.slot >= kMaxObjects || !slots.insert(o.slot).second) {
      Fail("object " + o.name + ": slot " + std::to_string(o.slot) + " is taken or not in 0 .. " +
           std::to_string(kMaxObjects - 1));
    }
    if (o.id < 0) Fail("object " + o.name + ": id " + std::to_string(o.id) + ", must be >= 0");
    if (o.tags.empty()) Fail("object " + o.name + " has no tags");
    for (const ObjectTag& t : o.tags) check_tag(t.id, t.size);
  }
  if (!(config.corner_sigma_px > 0)) {
    Fail("corner_sigma_px: " + std::to_string(config.corner_sigma_px) + ", must be > 0");
  }
}

PerceptionConfig LoadPerceptionConfig(const std::string& path) {
  std::ifstream file(path);
  if (!file) Fail(path + ": cannot be read");
  std::stringstream text;
  text << "%YAML:1.0\n---\n" << file.rdbuf();  // the heading that OpenCV insists on
  try {
    const cv::FileStorage storage(
        text.str(), cv::FileStorage::READ | cv::FileStorage::MEMORY | cv::FileStorage::FORMAT_YAML);
    PerceptionConfig config = Read(storage.root());
    Check(config);
    return config;
  } catch (const cv::Exception& e) {
    Fail(path + ": not readable as YAML: " + e.err);
  } catch (const std::runtime_error& e) {
    Fail(path + ": " + e.what());
  }
}

}  // namespace intabs
