#include "view.h"

#include <chrono>
#include <optional>
#include <vector>

#include "intabs/camera/frame_ring.h"
#include "intabs/camera/strip.h"
#include "intabs/camera/video_writer.h"
#include "intabs/plant/renderer.h"
#include "intabs/plant/viewer.h"

namespace intabs {
namespace {

constexpr int kWidth = 640, kHeight = 480;
const std::vector<std::string> kCameras = {"left", "right"};  // those perception sees
constexpr char kFilmCamera[] = "overview";
constexpr double kFramesPerSecond = 1e6 / kPolicyPeriodUs;
constexpr int kStripPictures = 8, kStripPictureWidth = 240;

}  // namespace

// Draws; belongs to the thread that makes it.
class Painter {
 public:
  Painter(const World& world, const PlantOptions& options)
      : strip_file_(options.strip), rgb_(3 * kWidth * kHeight) {
    if (options.cameras || !options.video.empty() || !options.strip.empty())
      renderer_.emplace(world, kWidth, kHeight);
    if (options.cameras) {
      for (const std::string& name : kCameras) cameras_.push_back(renderer_->FindCamera(name));
      pictures_.assign(cameras_.size(), rgb_);
      ring_.emplace(options.ring, kCameras, kWidth, kHeight);
    }
    if (!options.video.empty() || !options.strip.empty()) film_camera_ = renderer_->FindCamera(kFilmCamera);
    if (!options.video.empty()) video_.emplace(options.video, kWidth, kHeight, kFramesPerSecond);
    if (!options.strip.empty()) strip_.emplace(kStripPictures, kStripPictureWidth);
    if (options.viewer) viewer_.emplace(world);
  }

  void PaintFrames(const Snapshot& snapshot, int64_t frame_seq, int64_t exposure_us) {
    for (size_t i = 0; i < cameras_.size(); ++i) renderer_->Render(snapshot, cameras_[i], pictures_[i].data());
    // Together, as cameras that are triggered together deliver them.
    for (size_t i = 0; i < cameras_.size(); ++i)
      ring_->Write(static_cast<int>(i), frame_seq, exposure_us, pictures_[i].data());
  }

  void PaintFilm(const Snapshot& snapshot, int64_t frame_seq) {
    if (video_ || strip_) renderer_->Render(snapshot, film_camera_, rgb_.data());
    if (strip_) strip_->Add(rgb_.data(), kWidth, kHeight);
    // A frame that was skipped is filled with the next one, so that the video keeps time.
    for (; video_ && filmed_seq_ < frame_seq; ++filmed_seq_) video_->Write(rgb_.data());
    filmed_seq_ = frame_seq;
    if (viewer_ && !viewer_->Show(snapshot)) viewer_.reset();
  }

  void Close() {
    if (video_) video_->Close();
    if (strip_ && filmed_seq_ > 0) strip_->Save(strip_file_);
  }

 private:
  const std::string strip_file_;
  std::optional<Renderer> renderer_;
  std::vector<int> cameras_;
  int film_camera_ = 0;
  std::optional<FrameRingWriter> ring_;
  std::optional<VideoWriter> video_;
  std::optional<PictureStrip> strip_;
  std::optional<Viewer> viewer_;
  int64_t filmed_seq_ = 0;
  std::vector<std::vector<uint8_t>> pictures_;  // of the cameras
  std::vector<uint8_t> rgb_;                    // of the film
};

std::unique_ptr<View> View::Make(const World& world, const PlantOptions& options) {
  if (!options.cameras && options.video.empty() && options.strip.empty() && !options.viewer) return nullptr;
  return std::unique_ptr<View>(new View(world, options));
}

View::View(const World& world, const PlantOptions& options) {
  if (options.clock == "lockstep") {
    painter_ = std::make_unique<Painter>(world, options);
    return;
  }
  thread_ = std::thread([this, &world, &options] { PaintInThread(world, options); });
  while (!ready_ && !failed_) std::this_thread::sleep_for(std::chrono::milliseconds(1));
  if (failed_) {
    thread_.join();
    std::rethrow_exception(failure_);
  }
}

View::~View() {
  stop_ = true;
  if (thread_.joinable()) thread_.join();
}

// `world` is looked at before ready_ only.
void View::PaintInThread(const World& world, const PlantOptions& options) {
  try {
    Painter painter(world, options);
    ready_ = true;
    while (!stop_) {
      const Shot* shot = shots_.Take();
      if (shot == nullptr) {
        std::this_thread::sleep_for(std::chrono::milliseconds(1));
        continue;
      }
      painter.PaintFrames(shot->snapshot, shot->frame_seq, shot->exposure_us);
      newest_frame_seq_ = shot->frame_seq;
      painter.PaintFilm(shot->snapshot, shot->frame_seq);
    }
    painter.Close();
  } catch (...) {
    failure_ = std::current_exception();
    failed_ = true;
  }
}

void View::Look(const World& world, int64_t frame_seq, int64_t exposure_us) {
  if (painter_) {
    world.Save(snapshot_);
    painter_->PaintFrames(snapshot_, frame_seq, exposure_us);
    newest_frame_seq_ = frame_seq;
    return;
  }
  if (failed_) std::rethrow_exception(failure_);
  Shot& shot = shots_.write_slot();
  world.Save(shot.snapshot);
  shot.frame_seq = frame_seq;
  shot.exposure_us = exposure_us;
  shots_.Publish();
}

void View::Film() {
  if (painter_) painter_->PaintFilm(snapshot_, newest_frame_seq_);
}

void View::Close() {
  if (painter_) {
    painter_->Close();
    painter_.reset();
    return;
  }
  stop_ = true;
  thread_.join();
  if (failed_) std::rethrow_exception(failure_);
}

}  // namespace intabs
