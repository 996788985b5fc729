#include "live.h"

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <functional>
#include <nlohmann/json.hpp>
#include <stdexcept>
#include <thread>

#include "intabs/rt/periodic.h"
#include "intabs/rt/stop_signal.h"

namespace intabs {
namespace {

constexpr int64_t kPatienceUs = 5'000'000;  // a plant or camera started at the same time needs a moment
constexpr int64_t kReportUs = 1'000'000;
constexpr int64_t kLostFrames = 125;       // 5 s at 25 Hz
constexpr int64_t kTogetherUs = 8000;      // exposures so near are one moment: .1 m/s makes .8 mm of it
constexpr int64_t kSilenceUs = 100'000;    // without frames: poses are published all the same
constexpr int64_t kRestartUs = 1'000'000;  // so far back: the camera's clock has started anew
constexpr int kGrainyFrames = 10;  // so many frames without a row seen before: a camera with a sensor's noise
constexpr int kOldRows = 8;        // of such a camera: so many rows seen before are an old picture's
constexpr int kOldFrames = 25;     // so many of them: it has no noise after all (a lens cap)
constexpr size_t kDepths = 16;      // frames that key points may come late
constexpr size_t kKeypoints = 256;  // messages that may be early: an estimator runs ahead through a recording
constexpr int64_t kSameFrameUs = 500;
constexpr int64_t kLastHandsUs = 300'000;  // for key points of a recording's last frames
constexpr double kMoving = 0.05;   // rad/s; .5 px a frame at .3 m from the base and .7 m from the camera

void Say(const std::string& what) { std::fprintf(stderr, "intabs_perception: %s\n", what.c_str()); }

// Calls `open` until it does not throw; gives up after a while, or at once where waiting cannot help.
void WaitFor(const std::function<void()>& open, bool patient) {
  for (const int64_t begin_us = MonotonicUs();;) {
    try {
      return open();
    } catch (const std::runtime_error&) {
      if (StopRequested()) return;
      if (!patient || MonotonicUs() - begin_us > kPatienceUs) throw;
      std::this_thread::sleep_for(std::chrono::milliseconds(50));
    }
  }
}

// Rows that are the same, bit for bit.
int SameRows(const cv::Mat& a, const cv::Mat& b) {
  int same = 0;
  for (int y = 0; y < a.rows && a.size() == b.size(); ++y)
    same += std::memcmp(a.ptr(y), b.ptr(y), static_cast<size_t>(a.cols)) == 0;
  return same;
}

}  // namespace

Live::Live(const LiveOptions& options)
    : options_(options),
      pipeline_(LoadPerceptionConfig(options.config), {.threads = options.threads}),
      bus_(options.lcm, options.prefix) {
  for (const CameraModel& c : pipeline_.config().cameras) cameras_.emplace_back(c).spec = c.source;
  images_.resize(cameras_.size());
  for (const std::string& s : options.sources) {
    const size_t cut = s.find('=');
    const auto named = [&](const Camera& c) {
      return cut != std::string::npos && c.model.name == s.substr(0, cut);
    };
    const auto camera = std::find_if(cameras_.begin(), cameras_.end(), named);
    if (camera == cameras_.end()) {
      std::string names;
      for (const Camera& c : cameras_) names += (names.empty() ? "" : " or ") + c.model.name;
      throw std::runtime_error("--source " + s + ": give CAMERA=KIND:WHERE, where CAMERA is " + names);
    }
    camera->spec = s.substr(cut + 1);
  }
  for (const Camera& c : cameras_) {
    if (c.spec.empty() == Sourced() || (Sourced() && IsRecording(c.spec) != IsRecording(cameras_[0].spec))) {
      throw std::runtime_error("cameras " + cameras_[0].model.name + " and " + c.model.name +
                               ": give all of them live sources, or all of them recordings, or none of them "
                               "one (the plant's ring)");
    }
  }
  if (options_.hands) {
    for (Camera& c : cameras_) {
      bus_.Subscribe(HandKeypointsChannel(c.model.name), [&c](const HandKeypoints& k) {
        c.keypoints.push_back(k);
        if (c.keypoints.size() <= kKeypoints) return;
        c.keypoints.pop_front();
        ++c.hands_missed;
      });
    }
  }
  if (Sourced()) {
    OpenSources();
  } else {
    OpenRing();
    bus_.Subscribe(kLite6Status,
                   std::function<void(const ArmStatus&)>([this](const ArmStatus& s) { status_.Offer(s); }));
  }
}

void Live::OpenRing() {
  ring_.reset();
  WaitFor([this] { ring_.emplace(options_.ring); }, true);
  if (!ring_) return;  // asked to stop meanwhile
  for (Camera& c : cameras_) {
    c.ring_camera = ring_->FindCamera(c.model.name);
    if (ring_->width() != c.model.width || ring_->height() != c.model.height) {
      throw std::runtime_error("camera " + c.model.name + " gives " + std::to_string(ring_->width()) + " x " +
                               std::to_string(ring_->height()) + " px, " + options_.config + " says " +
                               std::to_string(c.model.width) + " x " + std::to_string(c.model.height) +
                               ": correct it there");
    }
  }
}

void Live::OpenSources() {
  for (Camera& c : cameras_) {
    const CameraRequest request{c.model.name, c.model.width, c.model.height, options_.hands};
    WaitFor([&] { c.source = OpenSource(c.spec, request, Say); }, !IsRecording(c.spec));
  }
}

void Live::Run() {
  published_us_ = MonotonicUs();
  if (!Sourced()) {
    RunBesidePlant();
  } else if (IsRecording(cameras_[0].spec)) {
    RunRecordings();
  } else {
    RunCameras();
  }
  PublishStatus();
}

void Live::RunBesidePlant() {
  while (!StopRequested()) {
    if (bus_.Handle(100) < 0) throw std::runtime_error("LCM is broken on " + options_.lcm);
    ArmStatus status;
    if (status_.Take(status)) OnStatus(status);
    LiftHands();
    PublishStatusNowAndThen(utime_);
  }
}

void Live::OnStatus(const ArmStatus& status) {
  if (status.source != source_) {
    OpenRing();
    if (!ring_) return;  // asked to stop meanwhile
    pipeline_.Reset();
    Forget();
    source_ = status.source;
    frame_seq_ = 0;
  }
  const bool again = status.seq == status_seq_;
  if (status.utime < utime_) Forget();
  status_seq_ = status.seq;
  utime_ = status.utime;
  if (status.last_frame_seq <= 0) return;
  if (status.last_frame_seq != frame_seq_) {
    LookAtRing(status);
  } else if (again) {
    bus_.Publish(kObjectPoses, poses_);
  }
}

void Live::Forget() {
  exposure_us_ = INT64_MIN;
  for (Camera& c : cameras_) {
    c.last_exposure_us = INT64_MIN;
    c.last_gray.release();
    c.depths.clear();
    c.keypoints.clear();
  }
}

void Live::LookAtRing(const ArmStatus& status) {
  const int64_t missed = frame_seq_ > 0 ? std::max<int64_t>(status.last_frame_seq - frame_seq_ - 1, 0) : 0;
  for (Camera& c : cameras_) {
    c.dropped += missed;
    const FrameRead read = ring_->Read(status.last_frame_seq, c.ring_camera, c.frame);
    c.fresh = read == FrameRead::kWhole;
    if (read == FrameRead::kAbsent) ++c.dropped;
    if (read == FrameRead::kTorn) ++c.torn;
  }
  Look(status.last_frame_seq, status.utime, status.dq.cwiseAbs().maxCoeff() > kMoving);
}

// Whether the camera's fresh frame shows something newer than all that was looked at before.
bool Live::IsNews(Camera& c, int64_t now_us, bool arm_moves) {
  if (c.frame.rgb.empty()) {
    ++c.torn;
    return false;
  }
  RgbToGray(c.frame.rgb, c.gray);
  const int same_rows = SameRows(c.gray, c.last_gray);
  cv::swap(c.gray, c.last_gray);  // now last_gray is that of this frame
  const bool grainy = c.grainy_frames >= kGrainyFrames;
  c.old_frames = same_rows < kOldRows ? 0 : c.old_frames + 1;
  if (same_rows == 0) {
    ++c.grainy_frames;
  } else if (!grainy || c.old_frames > kOldFrames) {
    c.grainy_frames = 0;
  }
  const int64_t exposure_us = c.frame.exposure_us;
  if (exposure_us == c.last_exposure_us || (same_rows == c.last_gray.rows && (arm_moves || grainy))) {
    ++c.doubled;
    return false;
  }
  if (same_rows >= kOldRows && grainy) {
    ++c.torn;
    return false;
  }
  if (exposure_us < c.last_exposure_us || exposure_us < exposure_us_) {
    ++c.late;
    return false;
  }
  c.last_exposure_us = exposure_us;
  if (now_us - exposure_us > kPolicyPeriodUs) ++c.late;
  return true;
}

void Live::RememberDepth(Camera& c) {
  if (!options_.hands || c.frame.depth.empty()) return;
  cv::Mat mm;
  if (c.depths.size() >= kDepths) {
    cv::swap(mm, c.depths.front().mm);
    c.depths.pop_front();
  }
  cv::swap(mm, c.frame.depth);  // the frame gets the old one's memory
  c.depths.push_back({c.frame.exposure_us, mm});
}

void Live::Hear() {
  if (!options_.hands) return;
  if (bus_.Handle(0) < 0) throw std::runtime_error("LCM is broken on " + options_.lcm);
  LiftHands();
}

void Live::LiftHands() {
  for (size_t i = 0; i < cameras_.size(); ++i) {
    Camera& c = cameras_[i];
    while (!c.keypoints.empty()) {
      const HandKeypoints& k = c.keypoints.front();
      const auto depth = std::find_if(c.depths.begin(), c.depths.end(), [&](const Camera::Depth& d) {
        return std::abs(d.exposure_us - k.exposure_utime) <= kSameFrameUs;
      });
      const bool found = depth != c.depths.end();
      // Its frame is still to come, unless a later one was looked at (what comes without depth has none).
      if (!found && k.exposure_utime > c.last_exposure_us) break;
      if (found && pipeline_.X_WC(static_cast<int>(i)) && pipeline_.in_place(static_cast<int>(i))) {
        LiftHand(static_cast<int>(i), k, depth->mm);
        ++c.hands;
      } else {
        ++c.hands_missed;
      }
      c.keypoints.pop_front();
    }
  }
}

void Live::LiftHand(int camera, const HandKeypoints& k, const cv::Mat& depth) {
  static_assert(kHandPoints == kNumHandPoints);
  Camera& c = cameras_[camera];
  HandFrame frame;
  frame.time = 1e-6 * static_cast<double>(k.exposure_utime);
  for (int i = 0; i < kHandPoints; ++i) frame.pixels[i] = {k.uv[i][0], k.uv[i][1]};
  frame.hand_C = intabs::LiftHand(c.model, frame.pixels, depth, 1e-3);
  frame.X_WC = *pipeline_.X_WC(camera);
  const HandEstimate hand = c.hand.Update(frame);
  TrackedHand m;
  m.utime = utime_;
  m.exposure_utime = k.exposure_utime;
  m.seq = c.hands + 1;
  m.frame_seq = k.frame_seq;
  m.score = k.score;
  for (int i = 0; i < kHandPoints; ++i) {
    for (int axis = 0; axis < 3; ++axis) m.p_W[i][axis] = static_cast<float>(hand.hand_W.p[i][axis]);
    m.sigma[i] = static_cast<float>(hand.sigma[i]);
    m.state[i] = static_cast<uint8_t>(hand.hand_W.state[i]);
  }
  bus_.Publish(HandPointsChannel(c.model.name), m);
}

void Live::Look(int64_t frame_seq, int64_t now_us, bool arm_moves) {
  frame_seq_ = frame_seq;
  int64_t newest_us = INT64_MIN;
  for (Camera& c : cameras_) {
    c.fresh = c.fresh && IsNews(c, now_us, arm_moves);
    if (c.fresh) newest_us = std::max(newest_us, c.frame.exposure_us);
  }
  for (size_t i = 0; i < cameras_.size(); ++i) {
    Camera& c = cameras_[i];
    // Of another moment than the newest one: together they would show what never was.
    if (c.fresh && newest_us - c.frame.exposure_us > kTogetherUs) {
      if (now_us - c.frame.exposure_us <= kPolicyPeriodUs) ++c.late;
      c.fresh = false;
    }
    images_[i] = c.fresh ? c.last_gray : cv::Mat();
    if (c.fresh) {
      ++c.frames;
      RememberDepth(c);
    }
    c.fresh = false;
  }
  // Without any image too: then the answer is that nothing was seen, and nobody waits for us in vain.
  exposure_us_ = std::max(exposure_us_, newest_us == INT64_MIN ? now_us : newest_us);
  pipeline_.Process(images_, frame_seq_, exposure_us_, poses_, detections_);
  ++frames_;
  poses_.utime = now_us;
  bus_.Publish(kObjectPoses, poses_);  // first: control waits for them
  for (size_t i = 0; i < cameras_.size(); ++i) {
    if (images_[i].empty()) continue;
    detections_[i].utime = now_us;
    bus_.Publish(cameras_[i].channel, detections_[i]);
    cameras_[i].detect_us.Add(pipeline_.detect_us(static_cast<int>(i)));
    detect_us_.Add(pipeline_.detect_us(static_cast<int>(i)));
  }
}

// What went by between the last frame of a source and this one. A camera that was away starts to count anew.
void Live::CountGap(Camera& c) {
  if (c.last_seq > 0 && c.frame.frame_seq > c.last_seq) c.dropped += c.frame.frame_seq - c.last_seq - 1;
  c.last_seq = c.frame.frame_seq;
}

void Live::RunCameras() {
  for (Camera& c : cameras_) {
    if (!c.source) return;  // asked to stop meanwhile
    c.grabber = std::make_unique<Grabber>(std::move(c.source), [this] {
      { const std::lock_guard lock(mutex_); }  // not between the look and the wait
      woken_.notify_one();
    });
  }
  int64_t first_us = 0;  // since when a frame has been waiting for those of the other cameras; 0: none
  int64_t looked_us = MonotonicUs();  // the last time
  int64_t clock_us = 0;               // exposure clock minus ours, of the last frame
  while (!StopRequested()) {
    {
      std::unique_lock lock(mutex_);
      woken_.wait_for(lock, std::chrono::milliseconds(first_us > 0 ? 2 : 20));
    }
    bool all = true;
    for (Camera& c : cameras_) {
      if (!c.fresh && (c.fresh = c.grabber->Take(c.frame))) {
        CountGap(c);
        if (c.frame.exposure_us < exposure_us_ - kRestartUs) Forget();
        if (first_us == 0) first_us = MonotonicUs();
        if (!c.frame.rgb.empty()) clock_us = c.frame.exposure_us - MonotonicUs();
      }
      all = all && (c.fresh || c.grabber->lost());
    }
    const int64_t now_us = MonotonicUs();
    utime_ = now_us;
    PublishStatusNowAndThen(now_us);
    // Where the writer's clock is not ours (a simulation's), nothing can be said of lateness.
    const bool our_clock = std::abs(clock_us) < kPatienceUs;
    const int64_t there_us = our_clock ? now_us : now_us + clock_us;
    if (first_us == 0 && now_us - looked_us > kSilenceUs && poses_.frame_seq > 0) {
      PublishSilence(there_us);
      looked_us = now_us;
    } else if (first_us > 0 ? all || now_us - first_us > kTogetherUs : now_us - looked_us > kSilenceUs) {
      Look(frame_seq_ + 1, there_us, false);
      first_us = 0;
      looked_us = now_us;
    }
    Hear();
  }
  for (Camera& c : cameras_) c.grabber.reset();
}

void Live::PublishSilence(int64_t now_us) {
  ObjectPoses poses = poses_;
  poses.utime = now_us;
  for (TrackedObject& o : poses.objects) {
    if (o.id < 0) continue;
    o.age += static_cast<float>(1e-6 * static_cast<double>(now_us - poses_.exposure_utime));
    o.valid = o.valid && o.age <= 1e-6 * Pipeline::kGapUs;
  }
  bus_.Publish(kObjectPoses, poses);
}

// Paced as recorded; no frame is left out.
void Live::RunRecordings() {
  int64_t begin_us = 0, first_us = 0;
  while (!StopRequested()) {
    int64_t next_us = INT64_MAX;
    for (Camera& c : cameras_) {
      if (c.frame.frame_seq == c.last_seq && !c.ended) c.ended = c.source->Next(c.frame) == Grab::kEnd;
      if (!c.ended) next_us = std::min(next_us, c.frame.exposure_us);
    }
    if (next_us == INT64_MAX) {
      for (const int64_t over_us = MonotonicUs(); options_.hands && MonotonicUs() - over_us < kLastHandsUs;) {
        std::this_thread::sleep_for(std::chrono::milliseconds(10));
        Hear();
      }
      return;
    }
    if (begin_us == 0) {
      begin_us = MonotonicUs();
      first_us = next_us;
    }
    while (MonotonicUs() - begin_us < next_us - first_us && !StopRequested()) {
      const int64_t left_us = next_us - first_us - (MonotonicUs() - begin_us);
      std::this_thread::sleep_for(std::chrono::microseconds(std::clamp<int64_t>(left_us, 0, 50'000)));
      PublishStatusNowAndThen(utime_);
      Hear();
    }
    for (Camera& c : cameras_) {
      c.fresh = !c.ended && c.frame.exposure_us - next_us <= kTogetherUs;
      if (c.fresh) CountGap(c);
    }
    utime_ = next_us;
    Look(frame_seq_ + 1, next_us, false);
    Hear();
    PublishStatusNowAndThen(utime_);
  }
}

void Live::PublishStatusNowAndThen(int64_t utime) {
  utime_ = utime;
  if (MonotonicUs() - published_us_ >= kReportUs) PublishStatus();
}

void Live::PublishStatus() {
  const int64_t now_us = MonotonicUs();
  const double seconds = 1e-6 * static_cast<double>(std::max<int64_t>(now_us - published_us_, 1));
  published_us_ = now_us;
  PerceptionStatus m;
  m.utime = utime_;
  m.seq = ++seq_;
  m.n = static_cast<int>(cameras_.size());
  for (int i = 0; i < m.n; ++i) {
    Camera& c = cameras_[i];
    m.frames[i] = c.frames;
    m.dropped[i] = c.dropped;
    m.late[i] = c.late;
    m.doubled[i] = c.doubled;
    m.torn[i] = c.torn;
    m.fps[i] = static_cast<float>(static_cast<double>(c.frames - c.reported) / seconds);
    m.detect_us_p50[i] = static_cast<float>(c.detect_us.PercentileUs(0.5));
    m.detect_us_p95[i] = static_cast<float>(c.detect_us.PercentileUs(0.95));
    c.reported = c.frames;
    c.detect_us.Clear();
    if (!pipeline_.X_WC(i) && !c.lost_said && c.frames > kLostFrames) {
      Say("camera " + c.model.name + " has not seen the ground tag (id " +
          std::to_string(pipeline_.config().ground->id) + ") yet and cannot contribute: bring it into view");
      c.lost_said = true;
    }
    if (!pipeline_.in_place(i) && !c.moved_said) {
      Say("camera " + c.model.name +
          " does not see the ground tag where it was: moved, or its cable swapped. It is left out meanwhile; "
          "restart to find its place anew");
      c.moved_said = true;
    } else if (pipeline_.in_place(i)) {
      c.moved_said = false;
    }
  }
  bus_.Publish(kPerceptionStatus, m);
}

void Live::WriteJson() const {
  if (options_.json.empty()) return;
  nlohmann::json figures{
      {"frames", frames_},
      {"undecodable", bus_.undecodable()},
      {"detect_ms",
       {{"p50", detect_us_.PercentileUs(0.5) / 1000}, {"p95", detect_us_.PercentileUs(0.95) / 1000}}}};
  for (const Camera& c : cameras_) {
    figures["cameras"][c.model.name] = {{"frames", c.frames},
                                        {"dropped", c.dropped},
                                        {"late", c.late},
                                        {"doubled", c.doubled},
                                        {"torn", c.torn}};
    if (options_.hands) {
      figures["cameras"][c.model.name]["hands"] = c.hands;
      figures["cameras"][c.model.name]["hands_missed"] = c.hands_missed;
    }
  }
  std::ofstream out(options_.json);
  out << figures.dump(2) << "\n";
  if (!out.flush()) throw std::runtime_error("cannot write " + options_.json);
}

}  // namespace intabs
