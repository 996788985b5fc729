#include "intabs/camera/video_writer.h"

#include <opencv2/core/utils/logger.hpp>
#include <opencv2/imgproc.hpp>
#include <opencv2/videoio.hpp>
#include <stdexcept>

namespace intabs {

struct VideoWriter::Impl {
  std::string path;
  cv::VideoWriter out;
  int width = 0, height = 0;
  int64_t frames = 0;
  cv::Mat bgr;
};

VideoWriter::VideoWriter(const std::string& path, int width, int height, double fps)
    : impl_(std::make_unique<Impl>()) {
  if (width < 2 || height < 2 || width % 2 || height % 2 || !(fps > 0)) {
    throw std::runtime_error(path + ": a video of " + std::to_string(width) + "x" + std::to_string(height) +
                             " at " + std::to_string(fps) +
                             " Hz cannot be written: sizes must be even, the rate positive");
  }
  impl_->path = path;
  impl_->width = width;
  impl_->height = height;
  // OpenCV would tell on stderr of each encoder it misses; we say it in one line of our own.
  const auto level = cv::utils::logging::setLogLevel(cv::utils::logging::LOG_LEVEL_SILENT);
  for (const int fourcc :
       {cv::VideoWriter::fourcc('a', 'v', 'c', '1'), cv::VideoWriter::fourcc('m', 'p', '4', 'v')}) {
    if (!impl_->out.isOpened()) impl_->out.open(path, cv::CAP_FFMPEG, fourcc, fps, {width, height});
  }
  cv::utils::logging::setLogLevel(level);
  if (!impl_->out.isOpened()) {
    throw std::runtime_error(
        path + ": cannot be written: its folder must exist, its name end in .mp4, and OpenCV have ffmpeg");
  }
}

VideoWriter::~VideoWriter() = default;

void VideoWriter::Write(const uint8_t* rgb) {
  const cv::Mat picture(impl_->height, impl_->width, CV_8UC3, const_cast<uint8_t*>(rgb));
  cv::cvtColor(picture, impl_->bgr, cv::COLOR_RGB2BGR);
  impl_->out.write(impl_->bgr);
  ++impl_->frames;
}

void VideoWriter::Close() {
  if (!impl_->out.isOpened()) return;
  impl_->out.release();
  if (impl_->frames == 0) return;  // a container without frames is no video; nothing to look at
  cv::VideoCapture in(impl_->path, cv::CAP_FFMPEG);
  const auto found = in.isOpened() ? static_cast<int64_t>(in.get(cv::CAP_PROP_FRAME_COUNT)) : 0;
  if (found != impl_->frames) {
    throw std::runtime_error(impl_->path + ": holds " + std::to_string(found) + " of " +
                             std::to_string(impl_->frames) + " frames: is the disk full?");
  }
}

}  // namespace intabs
