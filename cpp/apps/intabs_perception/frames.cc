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
#include "intabs/perception/pose_track.h"

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
  std::map<int, size_t> last_seen{};  // frame, by tag

  // What was seen in the last three seconds but not in the frame before is looked for in whole frames.
  bool Misses(size_t frame) const {
    return std::any_of(last_seen.begin(), last_seen.end(),
                       [&](const auto& t) { return frame > t.second + 1 && frame < t.second + 90; });
  }
};

// What all frames show of one tag.
struct Sequence {
  std::vector<std::vector<ObjectPose>> poses;  // hypotheses, by frame
  std::vector<Verdict> verdicts;
  PoseTrack track;
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
json RightCovariance(const Pose& X_WT, const Matrix6d& covariance) {
  const Eigen::Matrix3d R_TW = X_WT.q.conjugate().toRotationMatrix();
  Matrix6d J = Matrix6d::Zero();
  J.topLeftCorner<3, 3>() = J.bottomRightCorner<3, 3>() = R_TW;
  const Matrix6d C = J * covariance * J.transpose();
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
  LibraryDetector library;
  double size = 0;
  bool independent = options.independent;
  std::vector<double> detect_ms, full_ms, time_s;
  std::map<int, Sequence> tags;
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
    for (const Camera& c : cameras) {
      placed.push_back({&c.model, *c.model.X_WC});
      if (options.extrinsic_sigma.size() == 2 && placed.size() > 1) {
        const double mm = options.extrinsic_sigma[0], deg = options.extrinsic_sigma[1];
        Vector6d sigma;
        sigma << Eigen::Vector3d::Constant(deg * M_PI / 180), Eigen::Vector3d::Constant(1e-3 * mm);
        placed.back().information = sigma.array().square().inverse().matrix().asDiagonal();
      }
    }
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
        const auto& seen = cameras[c].detector.Detect(gray, {}, f % 12 == 5 * c % 12 || cameras[c].Misses(f));
        detect_ms.push_back(Milliseconds(start));
        for (const SeenTag& t : seen) {
          cameras[c].last_seen[t.id] = f;
          views[t.id].push_back({static_cast<int>(c), size, Pose{}, t.corners,
                                 SolveTag(cameras[c].model, size, t.corners), t.covariance});
        }
        if (f % kFullFrameEvery == 0) {
          const auto full_start = Clock::now();
          library.Detect(gray);
          full_ms.push_back(Milliseconds(full_start));
        }
      }
      time_s.push_back(frames[f].value("time_s", static_cast<double>(f)));
      for (auto& [id, v] : views) {
        const ObjectFit fit = SolveObject(placed, std::move(v), {});
        if (!fit.ok) continue;
        Sequence& sequence = tags[id];
        sequence.poses.resize(frames.size());
        sequence.verdicts.resize(frames.size());
        sequence.poses[f] = fit.minima;
        if (independent) {
          const bool agreed = fit.rms_px <= ObjectSolverLimits{}.max_rms_px;
          sequence.verdicts[f] = {agreed ? 0 : -1, fit.p_wrong};
        } else {
          sequence.verdicts[f] = Judge(sequence.track.Update(time_s.back(), fit.minima));
        }
      }
      if (Clock::now() - told > std::chrono::seconds(2)) {
        told = Clock::now();
        std::cerr << "intabs_perception: frame " << f + 1 << " of " << frames.size() << "\n";
      }
    }
  } catch (const json::exception& e) {
    throw std::runtime_error(head_file + ": " + e.what());
  }
  if (options.offline && !independent) {
    for (auto& [id, sequence] : tags) {
      const auto evidence = PoseTrack::Revise(time_s, sequence.poses);
      for (size_t f = 0; f < evidence.size(); ++f) {
        sequence.verdicts[f] = Judge(evidence[f]);
      }
    }
  }
  for (size_t f = 0; f < time_s.size(); ++f) {
    json poses = json::object(), covariances = json::object();
    for (const auto& [id, sequence] : tags) {
      const auto& minima = sequence.poses[f];
      const Verdict& verdict = sequence.verdicts[f];
      if (minima.empty() || verdict.hypothesis < 0) continue;
      const ObjectPose& chosen = minima[verdict.hypothesis];
      Matrix6d covariance = chosen.covariance;
      if (minima.size() == 2) {
        covariance = CovarianceOfChoice(chosen, minima[1 - verdict.hypothesis], verdict.p_wrong);
      }
      poses[std::to_string(id)] = Matrix4(chosen.X_WO);
      covariances[std::to_string(id)] = RightCovariance(chosen.X_WO, covariance);
    }
    result.push_back({{"frame", f}, {"tags", poses}, {"covariance", covariances}});
  }
  const auto write = [](const std::string& file, const json& content) {
    std::ofstream out(file);
    out << content.dump() << "\n";
    if (!out.flush()) throw std::runtime_error(file + ": cannot be written");
  };
  write(options.result, result);
  const double p50 = Percentile(detect_ms, .5), full = Percentile(full_ms, .5);
  const json figures{{"frames", time_s.size()},
                     {"detect_ms", {{"p50", p50}, {"p95", Percentile(detect_ms, .95)}}},
                     {"full_frame_ms", {{"p50", full}}},
                     {"ratio", full > 0 ? p50 / full : 0}};
  if (!options.json.empty()) write(options.json, figures);
  std::cout << figures.dump() << "\n";
}

}  // namespace intabs
