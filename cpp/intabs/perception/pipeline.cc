#include "intabs/perception/pipeline.h"

#include <chrono>
#include <cmath>
#include <opencv2/imgproc.hpp>
#include <stdexcept>
#include <string>

namespace intabs {
namespace {

constexpr double kMovedPx = 3;  // the ground tag's RMS distance from its place that tells of a moved camera
constexpr double kSameGroundPx = 1;  // while averaging: a larger step starts the mean again
constexpr double kGroundAmbiguity = 0.6;
constexpr double kGroundSame =
    5 * M_PI / 180;                     // seen face on, the two hypotheses grow together: either will do
constexpr double kFacing = 0.1;         // cosine; tags seen more obliquely are not looked for
constexpr double kObjectMarginPx = 24;  // 0.5 m/s at 0.6 m is 20 px a frame at 25 Hz
constexpr double kGroundMarginPx = 6;
constexpr int kSlowScan = 4;  // what is missing for long is looked for in each camera every so many frames

double RmsDistance(const TagCorners& a, const TagCorners& b) {
  double sum = 0;
  for (int k = 0; k < 4; ++k) sum += (a[k] - b[k]).squaredNorm();
  return std::sqrt(sum / 4);
}

// Where a tag appears, with its white border and a margin; empty when it faces away.
cv::Rect Appearance(const CameraModel& camera, const Pose& X_CT, double size, double margin) {
  if (!(X_CT.p.z() > 0.05)) return {};
  const Eigen::Vector3d normal = X_CT.q * Eigen::Vector3d::UnitZ();  // into the tag
  if (normal.dot(X_CT.p.normalized()) < kFacing) return {};
  Eigen::Vector2d lo(1e9, 1e9), hi(-1e9, -1e9);
  for (const Eigen::Vector3d& p : TagPoints(size * 1.25)) {
    const Eigen::Vector3d p_C = X_CT * p;
    if (!(p_C.z() > 0.02)) return {};
    const Eigen::Vector2d uv = camera.Project(p_C);
    lo = lo.cwiseMin(uv);
    hi = hi.cwiseMax(uv);
  }
  const Eigen::Vector2d corner(camera.width, camera.height);
  lo = (lo.array() - margin).max(0).matrix();
  hi = (hi.array() + margin).matrix().cwiseMin(corner);
  if (!(hi.x() - lo.x() >= 1 && hi.y() - lo.y() >= 1)) return {};
  return {cv::Point(lo.x(), lo.y()), cv::Point(hi.x(), hi.y())};
}

}  // namespace

Pipeline::Pipeline(PerceptionConfig config) : config_(std::move(config)) {
  Check(config_);
  Reset();
}

void Pipeline::Reset() {
  std::vector<int> ids;
  if (config_.ground) ids.push_back(config_.ground->id);
  for (const ObjectModel& o : config_.objects) {
    for (const ObjectTag& t : o.tags) ids.push_back(t.id);
  }
  cameras_.clear();
  for (size_t c = 0; c < config_.cameras.size(); ++c) {
    Camera& camera = cameras_.emplace_back(config_.cameras[c], TagDetector(ids));
    camera.X_WC = camera.model.X_WC;
  }
  tracks_.fill({});
  seq_ = 0;
}

void Pipeline::RedoExtrinsics() {
  for (Camera& camera : cameras_) {
    camera.X_WC = camera.model.X_WC;
    camera.ground_frames = 0;
    camera.in_place = true;
  }
}

std::optional<Pose> Pipeline::X_WC(int camera) const { return cameras_[camera].X_WC; }

// Extrinsics from the ground tag, and whether the camera still stands there.
void Pipeline::Place(Camera& camera) {
  camera.in_place = true;
  if (!config_.ground) return;
  const GroundTag& ground = *config_.ground;
  const SeenTag* tag = nullptr;
  for (const SeenTag& t : camera.seen) {
    if (t.id == ground.id) tag = &t;
  }
  if (!tag) return;
  const bool fixed = camera.model.X_WC || camera.ground_frames >= kGroundFrames;
  if (!fixed) {
    if (camera.ground_frames > 0) {
      TagCorners mean;
      for (int k = 0; k < 4; ++k) mean[k] = camera.ground_sum[k] / camera.ground_frames;
      if (RmsDistance(mean, tag->corners) > kSameGroundPx) camera.ground_frames = 0;
    }
    if (camera.ground_frames == 0) camera.ground_sum.fill(Eigen::Vector2d::Zero());
    ++camera.ground_frames;
    TagCorners mean;
    for (int k = 0; k < 4; ++k) {
      camera.ground_sum[k] += tag->corners[k];
      mean[k] = camera.ground_sum[k] / camera.ground_frames;
    }
    const TagPose pose = SolveTag(camera.model, ground.size, mean);
    const bool clear =
        pose.ambiguity <= kGroundAmbiguity || AngleBetween(pose.X_CT[0].q, pose.X_CT[1].q) < kGroundSame;
    if (pose.ok && clear) {
      camera.X_WC = ground.X_WT * pose.X_CT[0].Inverse();
    } else {
      camera.ground_frames = 0;
      camera.X_WC.reset();
    }
    return;
  }
  TagCorners place;
  const Pose X_CT = camera.X_WC->Inverse() * ground.X_WT;
  const auto points = TagPoints(ground.size);
  for (int k = 0; k < 4; ++k) place[k] = camera.model.Project(X_CT * points[k]);
  camera.in_place = RmsDistance(place, tag->corners) <= kMovedPx;
}

std::vector<cv::Rect> Pipeline::Expected(const Camera& camera, int64_t exposure_us) const {
  std::vector<cv::Rect> regions;
  if (!camera.X_WC) return regions;
  const Pose X_CW = camera.X_WC->Inverse();
  const auto add = [&](const Pose& X_WT, double size, double margin) {
    const cv::Rect r = Appearance(camera.model, X_CW * X_WT, size, margin);
    if (!r.empty()) regions.push_back(r);
  };
  if (config_.ground) add(config_.ground->X_WT, config_.ground->size, kGroundMarginPx);
  for (const ObjectModel& o : config_.objects) {
    const Track& track = tracks_[o.slot];
    if (!track.seen || exposure_us - track.seen_us > kHoldUs) continue;
    for (const ObjectTag& t : o.tags) add(track.X_WO * t.X_OT, t.size, kObjectMarginPx);
  }
  return regions;
}

// Whole frames are looked at only while something is missing, and the cameras take turns.
bool Pipeline::ScanDue(int camera) const {
  const int n = static_cast<int>(cameras_.size());
  if (!cameras_[camera].X_WC) return seq_ % kSlowScan == camera % kSlowScan;
  bool slow = false;
  for (const ObjectModel& o : config_.objects) {
    const Track& track = tracks_[o.slot];
    if (track.missing_frames == 0) continue;
    if (track.missing_frames <= kSlowScan * n) return seq_ % n == camera;
    slow = true;
  }
  return slow && seq_ % (kSlowScan * n) == kSlowScan * camera;
}

void Pipeline::Process(const GrayImages& images, int64_t frame_seq, int64_t exposure_us, ObjectPoses& out,
                       CameraDetections& detections) {
  if (images.size() != cameras_.size()) {
    throw std::runtime_error("perception: " + std::to_string(images.size()) + " images for " +
                             std::to_string(cameras_.size()) + " cameras");
  }
  for (size_t c = 0; c < images.size(); ++c) {
    const CameraModel& model = cameras_[c].model;
    if (!images[c].empty() && (images[c].cols != model.width || images[c].rows != model.height)) {
      throw std::runtime_error("perception: camera " + model.name + " gave " +
                               std::to_string(images[c].cols) + " x " + std::to_string(images[c].rows) +
                               " px, the configuration says " + std::to_string(model.width) + " x " +
                               std::to_string(model.height));
    }
  }
  if (seq_ == 0 || exposure_us < last_us_) tracks_.fill({});
  last_us_ = exposure_us;
  ++seq_;

  for (size_t c = 0; c < cameras_.size(); ++c) {
    Camera& camera = cameras_[c];
    const auto start = std::chrono::steady_clock::now();
    camera.seen =
        camera.detector.Detect(images[c], Expected(camera, exposure_us), ScanDue(static_cast<int>(c)));
    camera.detect_us =
        std::chrono::duration<double, std::micro>(std::chrono::steady_clock::now() - start).count();
    Place(camera);

    TagDetections& d = detections[c];
    d = TagDetections{};
    d.utime = d.exposure_utime = exposure_us;
    d.seq = seq_;
    d.frame_seq = frame_seq;
  }
  for (size_t c = cameras_.size(); c < detections.size(); ++c) detections[c] = TagDetections{};

  // Poses of single tags: for the message, and as starts of the joint solve.
  std::array<std::vector<TagView>, kMaxObjects> views;
  std::vector<PlacedCamera> placed;
  for (size_t c = 0; c < cameras_.size(); ++c) {
    const Camera& camera = cameras_[c];
    placed.push_back({&camera.model, camera.X_WC.value_or(Pose{})});
    for (const SeenTag& tag : camera.seen) {
      const bool is_ground = config_.ground && config_.ground->id == tag.id;
      const ObjectModel* object = nullptr;
      const ObjectTag* place = nullptr;
      for (const ObjectModel& o : config_.objects) {
        for (const ObjectTag& t : o.tags) {
          if (t.id == tag.id) {
            object = &o;
            place = &t;
          }
        }
      }
      const double size = is_ground ? config_.ground->size : place->size;
      const TagPose pose = SolveTag(camera.model, size, tag.corners);
      TagDetections& d = detections[c];
      if (pose.ok && d.n < kMaxTags) {
        TagDetection& m = d.tags[d.n++];
        m.id = tag.id;
        for (int k = 0; k < 4; ++k) m.corners[k] = tag.corners[k].cast<float>();
        m.X_CT = pose.X_CT;
        for (int i = 0; i < 2; ++i) m.reprojection_px[i] = static_cast<float>(pose.reprojection_px[i]);
        m.ambiguity = static_cast<float>(pose.ambiguity);
        m.decision_margin = tag.decision_margin;
      }
      if (object && camera.X_WC && camera.in_place) {
        views[object->slot].push_back({static_cast<int>(c), place->size, place->X_OT, tag.corners, pose});
      }
    }
  }

  out = ObjectPoses{};
  out.utime = out.exposure_utime = exposure_us;
  out.seq = seq_;
  out.frame_seq = frame_seq;
  const ObjectSolverLimits limits{.corner_sigma_px = config_.corner_sigma_px};
  for (const ObjectModel& o : config_.objects) {
    Track& track = tracks_[o.slot];
    TrackedObject& object = out.objects[o.slot];
    const ObjectFit fit = SolveObject(placed, std::move(views[o.slot]), limits);
    if (fit.valid) {
      track.X_WO = fit.X_WO;
      track.covariance = PackCovariance(fit.covariance);
      track.seen = true;
      track.seen_us = exposure_us;
      track.missing_frames = 0;
      object.cameras = fit.cameras;
    } else {
      ++track.missing_frames;
    }
    if (!track.seen) continue;
    object.id = o.id;
    object.X_WO = track.X_WO;
    object.covariance = track.covariance;
    object.age = static_cast<float>(1e-6 * (exposure_us - track.seen_us));
    object.valid = exposure_us - track.seen_us <= kHoldUs;
  }
}

void RgbToGray(const cv::Mat& rgb, cv::Mat& gray) { cv::cvtColor(rgb, gray, cv::COLOR_RGB2GRAY); }

}  // namespace intabs
