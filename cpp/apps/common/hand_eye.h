// X_WB, the arm base in W, from a calibration file (tools/calibrate hand-eye) or the configuration of
// intabs_perception that names one.
#pragma once

#include <array>
#include <cmath>
#include <stdexcept>
#include <string>

#include "intabs/core/pose.h"
#include "intabs/perception/yaml.h"

namespace intabs {

// Throws std::runtime_error, one line with file and key. Identity where the file says nothing of it.
// `named`: by another file's `calibration`; such a file names no third one (it might be itself).
inline Pose LoadHandEye(const std::string& file, bool named = false) {
  const auto fail = [](const std::string& what) { throw std::runtime_error(OneLine(what)); };
  const YAML::Node root = LoadYaml(file);
  if (!root.IsMap()) fail(file + ": expected a map of values");
  if (const YAML::Node other = root["calibration"]) {
    if (!other.IsScalar()) fail(file + ": calibration: expected a file name");
    if (named) fail(file + ": calibration: this file is one itself; take the line out");
    const std::string name = other.Scalar();
    return LoadHandEye(name.starts_with('/') ? name : file.substr(0, file.rfind('/') + 1) + name, true);
  }
  const YAML::Node node = root["X_WB"];
  if (!node) return {};
  const auto numbers = [&](const char* key, auto& out) {
    const YAML::Node list = node.IsMap() ? node[key] : YAML::Node();
    const std::string where =
        file + ": X_WB." + key + ": expected " + std::to_string(out.size()) + " numbers";
    if (!list || !list.IsSequence() || list.size() != out.size()) fail(where);
    for (size_t i = 0; i < out.size(); ++i) {
      try {
        out[i] = list[i].as<double>();
      } catch (const YAML::Exception&) {
        fail(where);
      }
    }
  };
  std::array<double, 3> p;
  std::array<double, 4> q;
  numbers("p", p);
  numbers("q", q);
  const Eigen::Quaterniond rotation(q[0], q[1], q[2], q[3]);
  if (!(std::abs(rotation.norm() - 1) < 1e-3))
    fail(file + ": X_WB.q: (w x y z) has not norm 1");
  return {{p[0], p[1], p[2]}, rotation.normalized()};
}

}  // namespace intabs
