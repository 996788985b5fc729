#include "intabs/camera/realsense.h"

#include <stdexcept>

#ifdef INTABS_REALSENSE

#include <chrono>
#include <cmath>
#include <librealsense2/rs.hpp>
#include <optional>

namespace intabs {
namespace {

class RealSenseSource : public FrameSource {
 public:
  RealSenseSource(const std::string& serial, const CameraRequest& camera) {
    rs2::config config;
    if (!serial.empty()) config.enable_device(serial);
    config.enable_stream(RS2_STREAM_COLOR, camera.width, camera.height, RS2_FORMAT_RGB8);
    if (camera.depth) {
      config.enable_stream(RS2_STREAM_DEPTH, RS2_FORMAT_Z16);
      align_.emplace(RS2_STREAM_COLOR);
    }
    try {
      const rs2::pipeline_profile profile = pipeline_.start(config);
      // Stamps of the sensor itself, turned into the host's time by the library.
      for (const rs2::sensor& sensor : profile.get_device().query_sensors()) {
        if (sensor.supports(RS2_OPTION_GLOBAL_TIME_ENABLED))
          sensor.set_option(RS2_OPTION_GLOBAL_TIME_ENABLED, 1);
      }
    } catch (const rs2::error& e) {
      throw std::runtime_error("RealSense " + serial + ": " + e.what());
    }
  }

  Grab Next(Frame& out) override {
    rs2::frameset frames;
    try {
      if (!pipeline_.try_wait_for_frames(&frames, 1000))
        throw std::runtime_error("RealSense gives no frames");
    } catch (const rs2::error& e) {
      throw std::runtime_error(std::string("RealSense: ") + e.what());
    }
    try {
      if (align_) frames = align_->process(frames);
    } catch (const rs2::error& e) {
      throw std::runtime_error(std::string("RealSense: ") + e.what());
    }
    const rs2::video_frame color = frames.get_color_frame();
    if (!color) return Grab::kNone;
    out.frame_seq = static_cast<int64_t>(color.get_frame_number());
    // The library's host time is that of the calendar; ours is CLOCK_MONOTONIC.
    const auto now = std::chrono::system_clock::now().time_since_epoch();
    const double age_ms = std::chrono::duration<double, std::milli>(now).count() - color.get_timestamp();
    const auto mono = std::chrono::steady_clock::now().time_since_epoch();
    out.exposure_us =
        std::chrono::duration_cast<std::chrono::microseconds>(mono).count() - std::llround(1000 * age_ms);
    const cv::Mat view(color.get_height(), color.get_width(), CV_8UC3, const_cast<void*>(color.get_data()),
                       static_cast<size_t>(color.get_stride_in_bytes()));
    view.copyTo(out.rgb);
    out.depth.release();
    if (const rs2::depth_frame depth = frames.get_depth_frame(); align_ && depth) {
      const cv::Mat counts(depth.get_height(), depth.get_width(), CV_16UC1,
                           const_cast<void*>(depth.get_data()),
                           static_cast<size_t>(depth.get_stride_in_bytes()));
      counts.convertTo(out.depth, CV_16UC1, 1000 * depth.get_units());
    }
    return Grab::kFrame;
  }

 private:
  rs2::pipeline pipeline_;
  std::optional<rs2::align> align_;
};

}  // namespace

std::unique_ptr<FrameSource> OpenRealSense(const std::string& serial, const CameraRequest& camera) {
  return std::make_unique<RealSenseSource>(serial, camera);
}

}  // namespace intabs

#else

namespace intabs {

std::unique_ptr<FrameSource> OpenRealSense(const std::string&, const CameraRequest& camera) {
  throw std::runtime_error(
      "camera " + camera.name +
      ": this build has no RealSense: install librealsense2 and its headers, then build anew");
}

}  // namespace intabs

#endif
