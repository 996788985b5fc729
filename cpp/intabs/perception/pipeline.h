// Grey frames of all cameras in, object poses in W out. The same code runs in intabs_perception, in
// in-process rollouts and in dataset preprocessing. Single thread; the answer depends on the sequence of
// frames alone.
#pragma once

#include <array>
#include <cstdint>
#include <opencv2/core/mat.hpp>
#include <optional>
#include <span>
#include <utility>
#include <vector>

#include "intabs/core/types.h"
#include "intabs/perception/config.h"
#include "intabs/perception/detector.h"
#include "intabs/perception/gaps.h"
#include "intabs/perception/object_solver.h"
#include "intabs/perception/pose_track.h"

namespace intabs {

using GrayImages = std::vector<cv::Mat>;  // one a camera, (H, W) CV_8UC1; empty: this camera gave nothing
using CameraDetections = std::array<TagDetections, kMaxCameras>;

struct PipelineOptions {
  int threads = 1;         // of the tag detector
  bool revisable = false;  // remember what Revised() needs
};

class Pipeline {
 public:
  // A pose is foretold for so long after the last frame that showed it: arm and fingers hide tags for
  // moments.
  static constexpr int64_t kGapUs = 500000;
  // The camera's place is the mean over so many frames of the ground tag, then fixed.
  static constexpr int kGroundFrames = 10;

  // Of the tag detector, a camera and frame: 640 x 480 costs this much looked at as a whole after regions and
  // a decimated scan found a tag gone, larger pictures are searched in parts.
  static constexpr int64_t kBudgetPx = 450000;

  explicit Pipeline(PerceptionConfig config,
                    const PipelineOptions& options = {});  // throws what Check() throws

  // out: every configured object, in its slot; of several that name the same slot the one seen last.
  //   Seen: pose and covariance of this frame, cameras that contributed, age 0, valid. Which of two poses it
  //   is, and
  //     whether this frame can be believed, is told by all frames so far (PoseTrack).
  //   Not seen, not believed, or still ambiguous: where the last poses lead (GapTracker), with a covariance
  //     that grows from that of the last one, age since then, cameras 0; valid up to an age of kGapUs,
  //     invalid after it (the last prediction is kept, the age grows on).
  //   Never seen: as an unused slot (id -1, null pose, invalid, age 0).
  // A camera contributes once the ground tag showed where it stands, and not in a frame that shows the ground
  // tag elsewhere (moved camera, swapped cables). detections: what each camera saw, at most kMaxTags each,
  // sorted by id. utime of both is exposure_us; seq counts the calls. An exposure earlier than the last one
  // forgets all poses. Throws std::runtime_error when the number, size or type of the images does not fit the
  // configuration.
  void Process(const GrayImages& images, int64_t frame_seq, int64_t exposure_us, ObjectPoses& out,
               CameraDetections& detections);

  // The poses of all frames since the last Reset(), decided anew with those after them in view; gaps of up to
  // kGapUs between two poses are filled (FillGaps), all else that was not seen is invalid. Only with
  // PipelineOptions::revisable, else empty.
  std::vector<ObjectPoses> Revised() const;

  void Reset();           // as new
  void RedoExtrinsics();  // finds the places of the cameras anew; poses are kept

  const PerceptionConfig& config() const { return config_; }
  std::optional<Pose> X_WC(int camera) const;  // unset: the ground tag was not seen yet
  // False when the last frame showed the ground tag over 3 px off its place.
  bool in_place(int camera) const { return cameras_[camera].in_place; }
  double detect_us(int camera) const {
    return cameras_[camera].detect_us;
  }  // tag detection of the last frame

 private:
  struct Camera {
    Camera(CameraModel m, TagDetector d) : model(std::move(m)), detector(std::move(d)) {}
    CameraModel model;
    TagDetector detector;
    std::optional<Pose> X_WC;
    std::optional<Matrix6d> information{};  // of X_WC (PlacedCamera); unset: from a calibration
    int ground_frames = 0;
    TagCorners ground_sum;
    bool in_place = true;
    double detect_us = 0;
    std::vector<SeenTag> seen;  // corners in ideal pixels (camera_model.h)
  };
  struct Track {
    Pose X_WO;  // of the last frame that showed it
    Matrix6d covariance = Matrix6d::Zero();
    GapTracker gap;
    bool seen = false;  // ever
    int64_t seen_us = 0;
    int missing_frames = 0;  // since it was seen last
  };
  // What a frame shows of one object.
  struct Sight {
    std::vector<ObjectPose> poses;  // ObjectFit::minima
    bool agreed = false;            // by all cameras
  };
  struct Record {
    ObjectPoses head;  // stamps alone
    std::vector<Sight> sights;
  };

  static void Report(const ObjectModel& model, const Sight& sight, const PoseTrack::Evidence& evidence,
                     Track& track, ObjectPoses& out);
  static void Foretell(const Track& track, int64_t exposure_us, TrackedObject& object);
  static void FillBetween(const ObjectModel& model, std::span<ObjectPoses> frames);

  void Place(Camera& camera);
  bool ScanDue(int camera) const;
  std::vector<cv::Rect> Expected(const Camera& camera, int64_t exposure_us) const;

  PerceptionConfig config_;
  std::vector<Camera> cameras_;
  PipelineOptions options_;
  std::vector<Track> tracks_;           // one a configured object
  std::vector<PoseTrack> pose_tracks_;  // likewise
  std::vector<Record> records_;
  int64_t seq_ = 0;
  int64_t last_us_ = 0;
};

// (H, W, 3) RGB, 8 bit, to grey as every user of Pipeline does it.
void RgbToGray(const cv::Mat& rgb, cv::Mat& gray);

}  // namespace intabs
