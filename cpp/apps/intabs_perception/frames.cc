#include "frames.h"

#include <algorithm>
#include <chrono>
#include <fstream>
#include <iostream>
#include <map>
#include <nlohmann/json.hpp>
#include <opencv2/imgcodecs.hpp>
#include <stdexcept>
#include <vector>

#include "intabs/perception/detector.h"
#include "intabs/perception/object_solver.h"

namespace intabs {
namespace {

using Clock = std::chrono::steady_clock;
using nlohmann::json;

constexpr int kFullFrameEvery = 10;  // frames between those that are also detected as a whole, for comparison

double Milliseconds(Clock::time_point start) {
  return std::chrono::duration<double, std::milli>(Clock::now() - start).count();
}

double Percentile(std::vector<double> v, double p) {
  if (v.empty()) return 0;
  const size_t k = static_cast<size_t>(p * (v.size() - 1));
  std::nth_element(v.begin(), v.begin() + k, v.end());
  return v[k];
}

struct Camera {
  CameraModel model;
  TagDetector detector{{}};
};

CameraModel ReadCamera(const std::string& name, const json& c) {
  CameraModel m;
  m.name = name;
  m.width = c.at("width");
  m.height = c.at("height");
  m.fx = c.at("K").at(0).at(0);
  m.cx = c.at("K").at(0).at(2);
  m.fy = c.at("K").at(1).at(1);
  m.cy = c.at("K").at(1).at(2);
  Eigen::Matrix3d R;
  Pose X_WC;
  for (int i = 0; i < 3; ++i) {
    for (int k = 0; k < 3; ++k) R(i, k) = c.at("X_WC").at(i).at(k);
    X_WC.p[i] = c.at("X_WC").at(i).at(3);
  }
  X_WC.q = Eigen::Quaterniond(R).normalized();
  m.X_WC = X_WC;
  return m;
}

json Matrix4(const Pose& X) {
  const Eigen::Matrix3d R = X.q.toRotationMatrix();
  json out = json::array();
  for (int i = 0; i < 3; ++i) out.push_back({R(i, 0), R(i, 1), R(i, 2), X.p[i]});
  out.push_back({0, 0, 0, 1});
  return out;
}

// From the left, in W (core/types.h), to the right, in the tag's frame.
json RightCovariance(const ObjectFit& fit) {
  const Eigen::Matrix3d R_TW = fit.X_WO.q.conjugate().toRotationMatrix();
  Matrix6d J = Matrix6d::Zero();
  J.topLeftCorner<3, 3>() = J.bottomRightCorner<3, 3>() = R_TW;
  const Matrix6d C = J * fit.covariance * J.transpose();
  json out = json::array();
  for (int i = 0; i < 6; ++i) out.push_back({C(i, 0), C(i, 1), C(i, 2), C(i, 3), C(i, 4), C(i, 5)});
  return out;
}

}  // namespace

void SolveFrames(const FramesOptions& options) {
  const std::string head_file = options.dir + "/frames.json";
  std::ifstream in(head_file);
  if (!in) throw std::runtime_error(head_file + ": cannot be read");
  json head, result = json::array();
  std::vector<Camera> cameras;
  double size = 0;
  bool independent = options.independent;
  std::vector<double> detect_ms, full_ms;
  try {
    head = json::parse(in);
    size = head.at("tag_size_m");
    independent = independent || head.value("independent", false);
    for (const auto& [name, c] : head.at("cameras").items()) {
      if (options.single && !cameras.empty()) break;
      cameras.push_back({.model = ReadCamera(name, c)});
    }
    const json& frames = head.at("frames");
    std::vector<PlacedCamera> placed;
    for (const Camera& c : cameras) placed.push_back({&c.model, *c.model.X_WC});
    auto told = Clock::now();
    for (size_t f = 0; f < frames.size(); ++f) {
      std::map<int, std::vector<TagView>> views;
      for (size_t c = 0; c < cameras.size(); ++c) {
        const std::string file =
            options.dir + "/" + frames[f].at("images").at(cameras[c].model.name).get<std::string>();
        const cv::Mat gray = cv::imread(file, cv::IMREAD_GRAYSCALE);
        if (gray.empty()) throw std::runtime_error(file + ": no readable image");
        if (independent) cameras[c].detector.Reset();
        const auto start = Clock::now();
        const auto& seen = cameras[c].detector.Detect(gray, {}, f % 12 == 5 * c % 12);
        detect_ms.push_back(Milliseconds(start));
        for (const SeenTag& t : seen) {
          views[t.id].push_back(
              {static_cast<int>(c), size, Pose{}, t.corners, SolveTag(cameras[c].model, size, t.corners)});
        }
        if (f % kFullFrameEvery == 0) {
          TagDetector whole({});
          const auto full_start = Clock::now();
          whole.Detect(gray, {}, true);
          full_ms.push_back(Milliseconds(full_start));
        }
      }
      json tags = json::object(), covariance = json::object();
      for (auto& [id, v] : views) {
        const ObjectFit fit = SolveObject(placed, std::move(v), {});
        if (!fit.ok) continue;
        tags[std::to_string(id)] = Matrix4(fit.X_WO);
        covariance[std::to_string(id)] = RightCovariance(fit);
      }
      result.push_back({{"frame", f}, {"tags", tags}, {"covariance", covariance}});
      if (Clock::now() - told > std::chrono::seconds(2)) {
        told = Clock::now();
        std::cerr << "intabs_perception: frame " << f + 1 << " of " << frames.size() << "\n";
      }
    }
  } catch (const json::exception& e) {
    throw std::runtime_error(head_file + ": " + e.what());
  }
  const auto write = [](const std::string& file, const json& content) {
    std::ofstream out(file);
    out << content.dump() << "\n";
    if (!out.flush()) throw std::runtime_error(file + ": cannot be written");
  };
  write(options.result, result);
  const double p50 = Percentile(detect_ms, .5), full = Percentile(full_ms, .5);
  const json figures{{"frames", result.size()},
                     {"detect_ms", {{"p50", p50}, {"p95", Percentile(detect_ms, .95)}}},
                     {"full_frame_ms", {{"p50", full}}},
                     {"ratio", full > 0 ? p50 / full : 0}};
  if (!options.json.empty()) write(options.json, figures);
  std::cout << figures.dump() << "\n";
}

}  // namespace intabs
