#include "live.h"

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <fstream>
#include <nlohmann/json.hpp>
#include <stdexcept>
#include <thread>

#include "intabs/rt/periodic.h"
#include "intabs/rt/stop_signal.h"

namespace intabs {
namespace {

constexpr int64_t kRingPatienceUs = 5'000'000;  // a plant started at the same time needs a moment
constexpr int64_t kReportUs = 1'000'000;
constexpr int64_t kLostFrames = 125;  // 5 s at 25 Hz

}  // namespace

Live::Live(const LiveOptions& options)
    : options_(options), pipeline_(LoadPerceptionConfig(options.config)), bus_(options.lcm, options.prefix) {
  const size_t n = pipeline_.config().cameras.size();
  images_.resize(n);
  counters_.resize(n);
  for (const CameraModel& c : pipeline_.config().cameras)
    tag_channels_.push_back(TagDetectionsChannel(c.name));
  OpenRing();
  bus_.Subscribe(kLite6Status,
                 std::function<void(const ArmStatus&)>([this](const ArmStatus& s) { status_.Offer(s); }));
}

void Live::OpenRing() {
  ring_.reset();
  for (const int64_t begin_us = MonotonicUs(); !ring_;) {
    try {
      ring_.emplace(options_.ring);
    } catch (const std::runtime_error&) {
      if (StopRequested()) return;
      if (MonotonicUs() - begin_us > kRingPatienceUs) throw;
      std::this_thread::sleep_for(std::chrono::milliseconds(50));
    }
  }
  ring_camera_.clear();
  for (const CameraModel& c : pipeline_.config().cameras) {
    ring_camera_.push_back(ring_->FindCamera(c.name));
    if (ring_->width() != c.width || ring_->height() != c.height) {
      throw std::runtime_error("camera " + c.name + " gives " + std::to_string(ring_->width()) + " x " +
                               std::to_string(ring_->height()) + " px, " + options_.config + " says " +
                               std::to_string(c.width) + " x " + std::to_string(c.height) +
                               ": correct it there");
    }
  }
}

void Live::Run() {
  published_us_ = MonotonicUs();
  while (!StopRequested()) {
    if (bus_.Handle(100) < 0) throw std::runtime_error("LCM is broken on " + options_.lcm);
    ArmStatus status;
    if (status_.Take(status)) OnStatus(status);
    if (MonotonicUs() - published_us_ >= kReportUs) PublishStatus();
  }
  PublishStatus();
}

void Live::OnStatus(const ArmStatus& status) {
  if (status.source != source_) {
    OpenRing();
    if (!ring_) return;  // asked to stop meanwhile
    pipeline_.Reset();
    source_ = status.source;
    frame_seq_ = 0;
  }
  const bool again = status.seq == status_seq_;
  status_seq_ = status.seq;
  utime_ = status.utime;
  if (status.last_frame_seq <= 0) return;
  if (status.last_frame_seq != frame_seq_) {
    Look(status);
  } else if (again) {
    bus_.Publish(kObjectPoses, poses_);
  }
}

void Live::Look(const ArmStatus& status) {
  const int64_t missed = frame_seq_ > 0 ? std::max<int64_t>(status.last_frame_seq - frame_seq_ - 1, 0) : 0;
  frame_seq_ = status.last_frame_seq;
  int64_t exposure_us = status.utime;  // unless a frame knows better
  for (size_t c = 0; c < images_.size(); ++c) {
    counters_[c].dropped += missed;
    if (ring_->Read(frame_seq_, ring_camera_[c], frame_)) {
      RgbToGray(frame_.rgb, images_[c]);
      exposure_us = frame_.exposure_us;
      ++counters_[c].frames;
      if (status.utime - exposure_us > kPolicyPeriodUs) ++counters_[c].late;
    } else {
      images_[c].release();
      ++counters_[c].dropped;
    }
  }
  // Without any image too: then the answer is that nothing was seen, and nobody waits for us in vain.
  pipeline_.Process(images_, frame_seq_, exposure_us, poses_, detections_);
  ++frames_;
  poses_.utime = status.utime;
  bus_.Publish(kObjectPoses, poses_);  // first: control waits for them
  for (size_t c = 0; c < images_.size(); ++c) {
    if (images_[c].empty()) continue;
    detections_[c].utime = status.utime;
    bus_.Publish(tag_channels_[c], detections_[c]);
    counters_[c].detect_us.Add(pipeline_.detect_us(static_cast<int>(c)));
    detect_us_.Add(pipeline_.detect_us(static_cast<int>(c)));
  }
}

void Live::PublishStatus() {
  const int64_t now_us = MonotonicUs();
  const double seconds = 1e-6 * static_cast<double>(std::max<int64_t>(now_us - published_us_, 1));
  published_us_ = now_us;
  PerceptionStatus m;
  m.utime = utime_;
  m.seq = ++seq_;
  m.n = static_cast<int>(counters_.size());
  for (int c = 0; c < m.n; ++c) {
    Counters& k = counters_[c];
    m.frames[c] = k.frames;
    m.dropped[c] = k.dropped;
    m.late[c] = k.late;
    m.fps[c] = static_cast<float>(static_cast<double>(k.frames - k.reported) / seconds);
    m.detect_us_p50[c] = static_cast<float>(k.detect_us.PercentileUs(0.5));
    m.detect_us_p95[c] = static_cast<float>(k.detect_us.PercentileUs(0.95));
    k.reported = k.frames;
    k.detect_us.Clear();
    const char* name = pipeline_.config().cameras[c].name.c_str();
    if (!pipeline_.X_WC(c) && !k.lost_said && k.frames > kLostFrames) {
      std::fprintf(stderr,
                   "intabs_perception: camera %s has not seen the ground tag (id %d) yet and cannot "
                   "contribute: bring it "
                   "into view\n",
                   name, pipeline_.config().ground->id);
      k.lost_said = true;
    }
    if (!pipeline_.in_place(c) && !k.moved_said) {
      std::fprintf(stderr,
                   "intabs_perception: camera %s does not see the ground tag where it was: moved, or its "
                   "cable swapped. "
                   "It is left out meanwhile; restart to find its place anew\n",
                   name);
      k.moved_said = true;
    } else if (pipeline_.in_place(c)) {
      k.moved_said = false;
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
  for (size_t c = 0; c < counters_.size(); ++c) {
    const Counters& k = counters_[c];
    figures["cameras"][pipeline_.config().cameras[c].name] = {
        {"frames", k.frames}, {"dropped", k.dropped}, {"late", k.late}};
  }
  std::ofstream out(options_.json);
  out << figures.dump(2) << "\n";
  if (!out.flush()) throw std::runtime_error("cannot write " + options_.json);
}

}  // namespace intabs
