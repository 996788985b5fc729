#include "intabs/sim/session.h"

namespace intabs {
namespace {
constexpr int kTicksPerPolicyTick = static_cast<int>(kPolicyPeriodUs / kDriverPeriodUs);
}

Session::Session(const std::string& models_dir, const std::string& task, std::optional<PerceptionConfig> perception)
    : sim_(models_dir, task), config_(std::move(perception)) {
  if (!config_) return;
  const CameraModel& first = config_->cameras.at(0);
  renderer_ = std::make_unique<Renderer>(sim_.world(), first.width, first.height);
  pipeline_ = std::make_unique<Pipeline>(*config_);
}

void Session::Reset(int64_t seed, double spread_cm) {
  sim_.Reset(seed, spread_cm);
  if (config_) pipeline_ = std::make_unique<Pipeline>(*config_);
  frame_seq_ = 0;
  Look();
}

Refusal Session::Advance(const ArmCommand& command) {
  const Refusal refusal = sim_.Accept(command);
  for (int i = 0; i < kTicksPerPolicyTick; ++i) sim_.Tick();
  Look();
  return refusal;
}

void Session::Look() {
  ++frame_seq_;
  sim_.Status(status_);
  status_.last_frame_seq = frame_seq_;
  if (!pipeline_) {
    PlantTruth truth;
    sim_.Truth(truth);
    truth.frame_seq = frame_seq_;
    poses_ = PosesFromTruth(truth);
    return;
  }
  const std::vector<CameraModel>& cameras = config_->cameras;
  GrayImages images(cameras.size());
  sim_.world().Save(snapshot_);
  cv::Mat rgb;
  for (size_t i = 0; i < cameras.size(); ++i) {
    rgb.create(cameras[i].height, cameras[i].width, CV_8UC3);
    renderer_->Render(snapshot_, static_cast<int>(i), rgb.data);
    RgbToGray(rgb, images[i]);
  }
  CameraDetections detections;
  pipeline_->Process(images, frame_seq_, status_.utime, poses_, detections);
}

}  // namespace intabs
