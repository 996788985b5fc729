// intabs_perception beside a running plant: frames from its ring, asked for by LITE6_STATUS.
#pragma once

#include <array>
#include <optional>
#include <string>
#include <vector>

#include "intabs/bus/lcm_bus.h"
#include "intabs/camera/frame_ring.h"
#include "intabs/perception/pipeline.h"
#include "intabs/rt/tick_stats.h"

namespace intabs {

struct LiveOptions {
  std::string lcm = kDefaultLcmUrl;
  std::string prefix;
  std::string ring = "/intabs_frames";
  std::string config = "models/config/perception.yaml";
  std::string json;  // empty: none
};

// A status with a new last_frame_seq asks for that frame, in lockstep and by the wall clock alike: frames
// that went by meanwhile are counted as dropped. A status that comes again (lockstep: our answer got lost)
// gets the same poses again. A status of another source is another plant: its ring is opened, and the
// cameras' places are found anew.
class Live {
 public:
  // Throws when the configuration or LCM does not hold, or no fitting ring turns up within 5 s.
  explicit Live(const LiveOptions& options);

  void Run();  // until a stop signal; throws when LCM breaks or a new plant has no ring
  void WriteJson() const;

 private:
  struct Counters {
    int64_t frames = 0, dropped = 0, late = 0;
    int64_t reported = 0;  // frames at the last PERCEPTION_STATUS
    TickStats detect_us;   // since then
    bool lost_said = false, moved_said = false;
  };

  void OpenRing();
  void OnStatus(const ArmStatus& status);
  void Look(const ArmStatus& status);
  void PublishStatus();

  const LiveOptions options_;
  Pipeline pipeline_;
  LcmBus bus_;
  Newest<ArmStatus> status_;
  std::optional<FrameRingReader> ring_;
  std::vector<int> ring_camera_;  // of each camera
  std::vector<Channel<TagDetections>> tag_channels_;

  int64_t source_ = 0;      // of the statuses followed
  int64_t status_seq_ = 0;  // of the last one
  int64_t utime_ = 0;       // its time
  int64_t frame_seq_ = 0;   // of the last frame, that of poses_; 0: none yet
  Frame frame_;
  GrayImages images_;
  ObjectPoses poses_;
  CameraDetections detections_;

  std::vector<Counters> counters_;
  TickStats detect_us_;
  int64_t frames_ = 0;
  int64_t published_us_ = 0;
  int64_t seq_ = 0;
};

}  // namespace intabs
