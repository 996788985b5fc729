// intabs_perception on running cameras, or on recordings as if they ran.
#pragma once

#include <array>
#include <condition_variable>
#include <deque>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <vector>

#include "intabs/bus/lcm_bus.h"
#include "intabs/camera/frame_ring.h"
#include "intabs/camera/frame_source.h"
#include "intabs/camera/grabber.h"
#include "intabs/perception/hand_tracker.h"
#include "intabs/perception/pipeline.h"
#include "intabs/rt/tick_stats.h"

namespace intabs {

struct LiveOptions {
  std::string lcm = kDefaultLcmUrl;
  std::string prefix;
  std::string ring = "/intabs_frames";
  std::string config = "models/config/perception.yaml";
  std::vector<std::string> sources;  // "CAMERA=KIND:WHERE", before what `config` says
  std::string json;                  // empty: none
  int threads = 1;                   // of the tag detector
  bool hands = false;                // HAND_KEYPOINTS_* and depth -> HAND_POINTS_*
};

// Without sources: beside a plant. A LITE6_STATUS with a new last_frame_seq asks for that frame of the
// plant's ring, in lockstep and by the wall clock alike. A status that comes again (lockstep: our answer got
// lost) gets the same poses again. A status of another source is another plant: its ring is opened, and the
// cameras' places are found anew. With sources: frames are looked at as they come, those of one moment
// together. While none come, poses are published all the same, so that they age and become invalid.
//
// Poses are those of the exposure that they are stamped with: what came twice, or after a newer one, is
// counted and not looked at.
//
// Hands: key points meet the depth of the frame with the same exposure time; they may come before or after
// it, in the order of the frames.
class Live {
 public:
  // Throws when the configuration or LCM does not hold, or a camera does not turn up within 5 s.
  explicit Live(const LiveOptions& options);

  void Run();  // until a stop signal or the end of the recordings; throws when LCM breaks or a new plant has
               // no ring
  void WriteJson() const;

 private:
  struct Camera {
    explicit Camera(const CameraModel& m) : model(m), channel(TagDetectionsChannel(m.name)) {}
    const CameraModel& model;
    Channel<TagDetections> channel;
    std::string spec;                     // source; empty: the plant's ring
    int ring_camera = 0;                  // index in the plant's ring
    std::unique_ptr<FrameSource> source;  // a recording
    std::unique_ptr<Grabber> grabber;     // a live camera

    Frame frame;         // the newest one
    bool fresh = false;  // not looked at yet
    bool ended = false;
    cv::Mat gray, last_gray;                // of frame, and of the one before
    int grainy_frames = 0, old_frames = 0;  // in succession: without a row seen before, with such rows
    int64_t last_seq = 0;                   // of a source
    int64_t last_exposure_us = INT64_MIN;

    int64_t frames = 0, dropped = 0, late = 0, doubled = 0, torn = 0;
    int64_t reported = 0;  // frames at the last PERCEPTION_STATUS
    TickStats detect_us;   // since then
    bool lost_said = false, moved_said = false;

    struct Depth {
      int64_t exposure_us;
      cv::Mat mm;
    };
    std::deque<Depth> depths;            // of the last frames, oldest first
    std::deque<HandKeypoints> keypoints;  // whose frame was not looked at yet
    HandTracker hand;
    int64_t hands = 0, hands_missed = 0;  // key points that became points in space, or did not
  };

  void OpenRing();
  void OpenSources();
  void RunBesidePlant();
  void RunCameras();
  void RunRecordings();

  void OnStatus(const ArmStatus& status);
  void LookAtRing(const ArmStatus& status);
  void CountGap(Camera& camera);
  // Looks at what is fresh: poses and detections go out.
  void Look(int64_t frame_seq, int64_t now_us, bool arm_moves);
  // What was seen last, as of then, grown older: a frame that is only late is still news.
  void PublishSilence(int64_t now_us);
  bool IsNews(Camera& camera, int64_t now_us, bool arm_moves);
  void RememberDepth(Camera& camera);
  void Hear();  // what came over the bus, where nothing else waits for it
  void LiftHands();
  void LiftHand(int camera, const HandKeypoints& keypoints, const cv::Mat& depth);
  void Forget();  // time starts again
  void PublishStatusNowAndThen(int64_t utime);
  void PublishStatus();
  bool Sourced() const { return !cameras_[0].spec.empty(); }

  const LiveOptions options_;
  Pipeline pipeline_;
  LcmBus bus_;
  std::vector<Camera> cameras_;
  Newest<ArmStatus> status_;
  std::optional<FrameRingReader> ring_;

  std::mutex mutex_;
  std::condition_variable woken_;

  int64_t source_ = 0;               // of the statuses followed
  int64_t status_seq_ = 0;           // of the last one
  int64_t utime_ = 0;                // its time
  int64_t frame_seq_ = 0;            // of the last frame, that of poses_; 0: none yet
  int64_t exposure_us_ = INT64_MIN;  // of poses_
  GrayImages images_;
  ObjectPoses poses_;
  CameraDetections detections_;

  TickStats detect_us_;
  int64_t frames_ = 0;
  int64_t published_us_ = 0;
  int64_t seq_ = 0;
};

}  // namespace intabs
