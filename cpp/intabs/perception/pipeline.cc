#include "intabs/perception/pipeline.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <opencv2/imgproc.hpp>
#include <stdexcept>
#include <string>

namespace intabs {
namespace {

constexpr double kMovedPx = 3;  // the ground tag's RMS distance from its place that tells of a moved camera
constexpr double kSameGroundPx = 1;  // while averaging: a larger step starts the mean again
constexpr double kMaxWrong = 0.01;   // a pose is believed up to this probability of being another one
constexpr double kGroundAmbiguity = 0.6;
constexpr double kGroundSame =
    5 * M_PI / 180;                     // seen face on, the two hypotheses grow together: either will do
constexpr double kFacing = 0.1;         // cosine; tags seen more obliquely are not looked for
// Around where an object is expected: 10 m/s^2 at 0.6 m is 8 px a frame at 25 Hz. What leaps further is found
// where it was (TagDetector) or by a scan.
constexpr double kObjectMarginPx = 12;
constexpr double kGroundMarginPx = 6;
// What errors in a row have in common must not look like motion.
constexpr double kGapSigma = 1e-3;       // [m]
constexpr double kGapSigmaAngle = 1e-2;  // [rad]
constexpr int kSlowScan = 4;  // what is missing for long is looked for in each camera every so many frames

double Square(double v) { return v * v; }

// Of one coordinate, with `more` beside it.
double Sigma(const Eigen::Matrix3d& covariance, double more) {
  return std::sqrt(covariance.trace() / 3 + Square(more));
}

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
    const Eigen::Vector2d uv = camera.Distort(camera.Project(p_C));
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

Pipeline::Pipeline(PerceptionConfig config, const PipelineOptions& options)
    : config_(std::move(config)), options_(options) {
  Check(config_);
  Reset();
}

void Pipeline::Reset() {
  std::vector<int> ids;
  if (config_.ground) ids.push_back(config_.ground->id);
  for (const ObjectModel& o : config_.objects) {
    for (const ObjectTag& t : o.tags) ids.push_back(t.id);
  }
  tracks_.assign(config_.objects.size(), Track());
  pose_tracks_.assign(config_.objects.size(), {});
  records_.clear();
  const DetectorOptions detector{.threads = options_.threads, .budget_px = kBudgetPx};
  cameras_.clear();
  for (size_t c = 0; c < config_.cameras.size(); ++c) {
    Camera& camera = cameras_.emplace_back(config_.cameras[c], TagDetector(ids, detector));
    camera.X_WC = camera.model.X_WC;
  }
  seq_ = 0;
}

void Pipeline::RedoExtrinsics() {
  for (Camera& camera : cameras_) {
    camera.X_WC = camera.model.X_WC;
    camera.information.reset();
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
    // Of one frame, not of their mean: the corners of a tag that stands still err alike in all of them.
    const double sigma = config_.corner_sigma_px;
    const Matrix8d covariance = tag->covariance + sigma * sigma * Matrix8d::Identity();
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
      const PlacedCamera here{&camera.model, Pose{}};
      std::array<PointView, 4> points;
      for (int k = 0; k < 4; ++k) points[k] = {TagPoints(ground.size)[k], mean[k], 0};
      const Matrix8d weight = Whitening(covariance);
      const PoseFit fit = FitPose({&here, 1}, points, pose.X_CT[0], {&weight, 1});
      camera.X_WC = ground.X_WT * fit.X_WO.Inverse();
      // X_WC Exp(e) = X_WT X_CT'^-1 for X_CT' = (Exp(w) R_CT, p_CT + dp): w = -e_r, dp = p_CT x e_r - e_p.
      const Eigen::Vector3d& p = fit.X_WO.p;
      Matrix6d to_motion = -Matrix6d::Identity();
      to_motion.bottomLeftCorner<3, 3>() << 0, -p.z(), p.y(), p.z(), 0, -p.x(), -p.y(), p.x(), 0;
      camera.information = to_motion.transpose() * fit.information * to_motion;
    } else {
      camera.ground_frames = 0;
      camera.X_WC.reset();
      camera.information.reset();
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
  for (size_t i = 0; i < tracks_.size(); ++i) {
    const Track& track = tracks_[i];
    if (!track.seen || exposure_us - track.seen_us > kGapUs) continue;
    const auto predicted = pose_tracks_[i].Predicted(1e-6 * static_cast<double>(exposure_us));
    const Pose X_WO = predicted.value_or(track.X_WO);
    for (const ObjectTag& t : config_.objects[i].tags) add(X_WO * t.X_OT, t.size, kObjectMarginPx);
  }
  return regions;
}

// Whole frames are looked at only while something is missing, and the cameras take turns.
bool Pipeline::ScanDue(int camera) const {
  const int n = static_cast<int>(cameras_.size());
  if (!cameras_[camera].X_WC) return seq_ % kSlowScan == camera % kSlowScan;
  bool slow = false;
  std::array<int, kMaxObjects> missing_frames;
  missing_frames.fill(std::numeric_limits<int>::max());
  for (size_t i = 0; i < tracks_.size(); ++i) {
    int& missing = missing_frames[config_.objects[i].slot];
    missing = std::min(missing, tracks_[i].missing_frames);
  }
  for (const ObjectModel& o : config_.objects) {
    if (missing_frames[o.slot] == 0) continue;
    if (missing_frames[o.slot] <= kSlowScan * n) return seq_ % n == camera;
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
  if (seq_ == 0 || exposure_us < last_us_) {
    tracks_.assign(tracks_.size(), Track());
    pose_tracks_.assign(pose_tracks_.size(), {});
  }
  last_us_ = exposure_us;
  ++seq_;

  for (size_t c = 0; c < cameras_.size(); ++c) {
    Camera& camera = cameras_[c];
    const auto start = std::chrono::steady_clock::now();
    camera.seen =
        camera.detector.Detect(images[c], Expected(camera, exposure_us), ScanDue(static_cast<int>(c)));
    if (camera.model.distorted()) {
      for (SeenTag& tag : camera.seen) {
        for (Eigen::Vector2d& corner : tag.corners) corner = camera.model.Undistort(corner);
      }
    }
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
  std::vector<std::vector<TagView>> views(config_.objects.size());  // one an object
  std::vector<PlacedCamera> placed;
  for (size_t c = 0; c < cameras_.size(); ++c) {
    const Camera& camera = cameras_[c];
    placed.push_back({&camera.model, camera.X_WC.value_or(Pose{}), camera.information});
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
        for (int k = 0; k < 4; ++k) m.corners[k] = camera.model.Distort(tag.corners[k]).cast<float>();
        m.X_CT = pose.X_CT;
        for (int i = 0; i < 2; ++i) m.reprojection_px[i] = static_cast<float>(pose.reprojection_px[i]);
        m.ambiguity = static_cast<float>(pose.ambiguity);
        m.decision_margin = tag.decision_margin;
      }
      if (object && camera.X_WC && camera.in_place) {
        views[object - config_.objects.data()].push_back(
            {static_cast<int>(c), place->size, place->X_OT, tag.corners, pose, tag.covariance});
      }
    }
  }

  out = ObjectPoses{};
  out.utime = out.exposure_utime = exposure_us;
  out.seq = seq_;
  out.frame_seq = frame_seq;
  const ObjectSolverLimits limits{.corner_sigma_px = config_.corner_sigma_px};
  if (options_.revisable) records_.push_back({out, std::vector<Sight>(tracks_.size())});
  for (size_t i = 0; i < tracks_.size(); ++i) {
    ObjectFit fit = SolveObject(placed, std::move(views[i]), limits);
    const Sight sight{std::move(fit.minima), fit.rms_px <= limits.max_rms_px};
    const auto evidence = pose_tracks_[i].Update(1e-6 * static_cast<double>(exposure_us), sight.poses);
    Report(config_.objects[i], sight, evidence, tracks_[i], out);
    if (options_.revisable) records_.back().sights[i] = sight;
  }
}

void Pipeline::Report(const ObjectModel& model, const Sight& sight, const PoseTrack::Evidence& evidence,
                      Track& track, ObjectPoses& out) {
  const int64_t exposure_us = out.exposure_utime;
  const Verdict verdict = Judge(evidence);
  // Of cameras that contradict each other one may be believed when it goes on where both were.
  const bool believed =
      verdict.hypothesis >= 0 && verdict.p_wrong <= kMaxWrong && (sight.agreed || evidence.continues);
  uint8_t cameras = 0;
  if (believed) {
    const ObjectPose& chosen = sight.poses[verdict.hypothesis];
    track.X_WO = chosen.X_WO;
    track.covariance = sight.agreed && sight.poses.size() == 2
                           ? CovarianceOfChoice(chosen, sight.poses[1 - verdict.hypothesis], verdict.p_wrong)
                           : chosen.covariance;
    (void)track.gap.Update(1e-6 * static_cast<double>(exposure_us), chosen.X_WO,
                           Sigma(track.covariance.bottomRightCorner<3, 3>(), kGapSigma),
                           Sigma(track.covariance.topLeftCorner<3, 3>(), kGapSigmaAngle));
    track.seen = true;
    track.seen_us = exposure_us;
    track.missing_frames = 0;
    cameras = chosen.cameras;
  } else {
    ++track.missing_frames;
  }
  TrackedObject& object = out.objects[model.slot];
  const auto age = static_cast<float>(1e-6 * static_cast<double>(exposure_us - track.seen_us));
  if (!track.seen || (object.id >= 0 && object.age <= age)) return;
  object.id = model.id;
  object.X_WO = track.X_WO;
  object.covariance = PackCovariance(track.covariance);
  object.cameras = cameras;
  object.age = age;
  object.valid = exposure_us - track.seen_us <= kGapUs;
  if (!believed) Foretell(track, exposure_us, object);
}

// The last pose, moved on as the tracker moved since then: nothing leaps when a gap begins.
void Pipeline::Foretell(const Track& track, int64_t exposure_us, TrackedObject& object) {
  const GapEstimate then = track.gap.Predict(1e-6 * static_cast<double>(track.seen_us));
  const GapEstimate now =
      track.gap.Predict(1e-6 * static_cast<double>(std::min(exposure_us, track.seen_us + kGapUs)));
  object.X_WO = {track.X_WO.p + now.pose.p - then.pose.p,
                 (track.X_WO.q * then.pose.q.conjugate() * now.pose.q).normalized()};
  Matrix6d covariance = track.covariance;
  covariance.diagonal().head<3>().array() += Square(now.sigma_angle) - Square(then.sigma_angle);
  covariance.diagonal().tail<3>().array() += Square(now.sigma) - Square(then.sigma);
  object.covariance = PackCovariance(covariance);
}

// In place of predictions what lies between two poses; where there is none, nobody knows.
void Pipeline::FillBetween(const ObjectModel& model, std::span<ObjectPoses> frames) {
  std::vector<TrackedObject*> objects;
  std::vector<double> time;
  std::vector<Pose> pose;
  std::vector<SampleState> state;
  for (ObjectPoses& frame : frames) {
    TrackedObject& object = frame.objects[model.slot];
    const double t = 1e-6 * static_cast<double>(frame.exposure_utime);
    if (object.id != model.id || (!time.empty() && t <= time.back())) continue;
    objects.push_back(&object);
    time.push_back(t);
    pose.push_back(object.X_WO);
    state.push_back(object.cameras != 0 ? SampleState::kMeasured : SampleState::kInvalid);
  }
  std::vector<double> sigma(time.size());
  FillGaps(time, pose, state, {.max_gap = 1e-6 * kGapUs, .sigma = kGapSigma}, sigma);
  GapTracker fresh;  // how a rotation's variance grows away from a pose
  (void)fresh.Update(0, Pose{}, kGapSigma, kGapSigmaAngle);
  size_t before = 0, after = 0;
  for (size_t k = 0; k < time.size(); ++k) {
    if (state[k] == SampleState::kMeasured) {
      before = k;
      continue;
    }
    objects[k]->valid = state[k] == SampleState::kFilled;
    if (!objects[k]->valid) continue;
    for (after = std::max(after, k); state[after] != SampleState::kMeasured;) ++after;
    const double a = Square(fresh.Predict(time[k] - time[before]).sigma_angle);
    const double b = Square(fresh.Predict(time[after] - time[k]).sigma_angle);
    Vector6d variance;
    variance << Eigen::Vector3d::Constant(a * b / (a + b)), Eigen::Vector3d::Constant(Square(sigma[k]));
    objects[k]->X_WO = pose[k];
    objects[k]->covariance = PackCovariance(variance.asDiagonal());
  }
}

std::vector<ObjectPoses> Pipeline::Revised() const {
  std::vector<ObjectPoses> out;
  // A step back in time parts two runs that have nothing to do with each other.
  for (size_t begin = 0, end = 0; begin < records_.size(); begin = end) {
    std::vector<double> time_s;
    for (end = begin; end < records_.size(); ++end) {
      if (end > begin && records_[end].head.exposure_utime < records_[end - 1].head.exposure_utime) break;
      time_s.push_back(1e-6 * static_cast<double>(records_[end].head.exposure_utime));
      out.push_back(records_[end].head);
    }
    for (size_t i = 0; i < config_.objects.size(); ++i) {
      std::vector<std::vector<ObjectPose>> poses;
      for (size_t r = begin; r < end; ++r) poses.push_back(records_[r].sights[i].poses);
      const auto evidence = PoseTrack::Revise(time_s, poses);
      Track track;
      for (size_t r = begin; r < end; ++r) {
        Report(config_.objects[i], records_[r].sights[i], evidence[r - begin], track, out[r]);
      }
      FillBetween(config_.objects[i], std::span(out).subspan(begin, end - begin));
    }
  }
  return out;
}

void RgbToGray(const cv::Mat& rgb, cv::Mat& gray) { cv::cvtColor(rgb, gray, cv::COLOR_RGB2GRAY); }

}  // namespace intabs
