#include "intabs/camera/frame_source.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <opencv2/core/utils/logger.hpp>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <opencv2/videoio.hpp>
#include <stdexcept>
#include <thread>
#include <vector>

#include "intabs/camera/frame_ring.h"
#include "intabs/camera/realsense.h"

namespace intabs {
namespace {

using std::chrono::milliseconds;
using std::chrono::steady_clock;

constexpr auto kRingPoll = milliseconds(1);
constexpr auto kPatience = milliseconds(100);   // of one Next()
constexpr auto kSuspicion = milliseconds(500);  // so long without a frame: is that ring still there?
constexpr auto kFirstRetry = milliseconds(100), kLastRetry = milliseconds(3000);
constexpr int64_t kFolderPeriodUs = 40000;
constexpr size_t kStampDigits = 10;
const std::string kColor = "_o", kDepthFile = "_depth.png";

int64_t NowUs() {  // CLOCK_MONOTONIC, like the drivers' stamps
  return std::chrono::duration_cast<std::chrono::microseconds>(steady_clock::now().time_since_epoch())
      .count();
}

void DemandSize(const std::string& where, const CameraRequest& camera, int width, int height) {
  if (camera.width == 0 || (width == camera.width && height == camera.height)) return;
  throw std::runtime_error("camera " + camera.name + ": " + where + " gives " + std::to_string(width) +
                           " x " + std::to_string(height) + " px, the configuration says " +
                           std::to_string(camera.width) + " x " + std::to_string(camera.height) +
                           ": correct it there");
}

class RingSource : public FrameSource {
 public:
  RingSource(const std::string& name, const CameraRequest& camera)
      : name_(name), ring_(name), camera_(ring_.FindCamera(camera.name)), heard_(steady_clock::now()) {
    DemandSize("frame ring \"" + name + "\"", camera, ring_.width(), ring_.height());
    seq_ = ring_.newest_seq();  // what lies there may be old
  }

  Grab Next(Frame& out) override {
    const auto begin = steady_clock::now();
    do {
      const int64_t newest = ring_.newest_seq();
      if (newest != seq_) {
        heard_ = steady_clock::now();
        seq_ = newest;
        const FrameRead read = ring_.Read(newest, camera_, out);
        if (read == FrameRead::kAbsent) continue;
        if (read == FrameRead::kTorn) out.rgb.release();
        return Grab::kFrame;
      }
      std::this_thread::sleep_for(kRingPoll);
    } while (steady_clock::now() - begin < kPatience);
    if (steady_clock::now() - heard_ > kSuspicion && !ring_.current())
      throw std::runtime_error("frame ring \"" + name_ + "\" is gone");
    return Grab::kNone;
  }

 private:
  const std::string name_;
  const FrameRingReader ring_;
  const int camera_;
  int64_t seq_ = 0;
  steady_clock::time_point heard_;
};

class V4l2Source : public FrameSource {
 public:
  V4l2Source(const std::string& device, const CameraRequest& camera) : device_(device) {
    // OpenCV waits 10 s for a frame of a camera that was unplugged.
    setenv("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "1", 0);
    if (!std::filesystem::exists(device)) throw std::runtime_error(device + ": there is no such camera");
    const auto level = cv::utils::logging::setLogLevel(cv::utils::logging::LOG_LEVEL_SILENT);
    capture_.open(device, cv::CAP_V4L2,
                  {cv::CAP_PROP_FRAME_WIDTH, camera.width, cv::CAP_PROP_FRAME_HEIGHT, camera.height,
                   cv::CAP_PROP_BUFFERSIZE, 2});
    cv::utils::logging::setLogLevel(level);
    if (!capture_.isOpened()) throw std::runtime_error(device + " cannot be opened as a V4L2 camera");
    DemandSize(device, camera, static_cast<int>(capture_.get(cv::CAP_PROP_FRAME_WIDTH)),
               static_cast<int>(capture_.get(cv::CAP_PROP_FRAME_HEIGHT)));
    const double fps = capture_.get(cv::CAP_PROP_FPS);
    period_us_ = fps > 1 ? 1e6 / fps : 0;
  }

  Grab Next(Frame& out) override {
    if (!capture_.read(bgr_) || bgr_.empty()) throw std::runtime_error(device_ + " gives no frames");
    auto exposure_us = static_cast<int64_t>(std::llround(1000 * capture_.get(cv::CAP_PROP_POS_MSEC)));
    // Some drivers stamp by another clock or not at all.
    if (std::abs(NowUs() - exposure_us) > 1'000'000) exposure_us = NowUs();
    const bool same = bgr_.size() == last_.size() && bgr_.isContinuous() &&
                      std::memcmp(bgr_.data, last_.data, bgr_.total() * bgr_.elemSize()) == 0;
    if (same) {
      exposure_us = exposure_us_;  // a sensor's noise never comes twice: an old buffer once more
    } else {
      bgr_.copyTo(last_);
    }
    const double gap = period_us_ > 0 && exposure_us_ > 0 ? (exposure_us - exposure_us_) / period_us_ : 1;
    seq_ += std::max<int64_t>(1, std::llround(gap));
    exposure_us_ = exposure_us;
    out.frame_seq = seq_;
    out.exposure_us = exposure_us;
    cv::cvtColor(bgr_, out.rgb, cv::COLOR_BGR2RGB);
    return Grab::kFrame;
  }

 private:
  const std::string device_;
  cv::VideoCapture capture_;
  cv::Mat bgr_, last_;
  double period_us_ = 0;  // 0: unknown
  int64_t seq_ = 0, exposure_us_ = 0;
};

class FolderSource : public FrameSource {
 public:
  FolderSource(const std::string& folder, const CameraRequest& camera) : folder_(folder), camera_(camera) {
    std::error_code error;
    bool deep = false;
    for (const auto& entry : std::filesystem::directory_iterator(folder, error)) {
      std::string ending = entry.path().extension().string();
      std::transform(ending.begin(), ending.end(), ending.begin(),
                     [](unsigned char c) { return std::tolower(c); });
      for (const char* known : {".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff"}) {
        if (ending == known) files_.push_back(entry.path());
      }
      deep = deep || entry.path().filename().string().ends_with(kDepthFile);
    }
    if (deep) {
      std::erase_if(files_,
                    [](const std::filesystem::path& f) { return !f.stem().string().ends_with(kColor); });
    }
    if (error) throw std::runtime_error(folder + ": " + error.message());
    if (files_.empty())
      throw std::runtime_error(folder + ": no pictures in it (png, jpg, bmp, pgm, ppm, tif)");
    std::sort(files_.begin(), files_.end());
  }

  Grab Next(Frame& out) override {
    if (next_ == files_.size()) return Grab::kEnd;
    const std::filesystem::path& file = files_[next_++];
    std::string stem = file.stem().string();
    const bool deep = stem.ends_with(kColor);
    if (deep) stem.resize(stem.size() - kColor.size());
    const bool stamp = stem.size() >= (deep ? 1 : kStampDigits) && stem.size() <= 18 &&
                       std::all_of(stem.begin(), stem.end(), [](char c) { return c >= '0' && c <= '9'; });
    out.frame_seq = static_cast<int64_t>(next_);
    out.exposure_us = stamp ? std::stoll(stem) : out.frame_seq * kFolderPeriodUs;
    const cv::Mat bgr = cv::imread(file, cv::IMREAD_COLOR);
    if (bgr.empty()) {
      out.rgb.release();
      return Grab::kFrame;
    }
    DemandSize(file.string(), camera_, bgr.cols, bgr.rows);
    cv::cvtColor(bgr, out.rgb, cv::COLOR_BGR2RGB);
    out.depth.release();
    if (deep && camera_.depth) ReadDepth(file.parent_path() / (stem + kDepthFile), bgr.size(), out.depth);
    return Grab::kFrame;
  }

 private:
  // None where there is no such file, or a broken one.
  static void ReadDepth(const std::filesystem::path& file, cv::Size size, cv::Mat& depth) {
    if (!std::filesystem::exists(file)) return;
    depth = cv::imread(file, cv::IMREAD_UNCHANGED);
    if (!depth.empty() && (depth.type() != CV_16UC1 || depth.size() != size))
      throw std::runtime_error(file.string() + ": a depth picture must have 16 bits and be as large as " +
                               "its colour picture, " + std::to_string(size.width) + " x " +
                               std::to_string(size.height));
  }

  const std::string folder_;
  const CameraRequest camera_;
  std::vector<std::filesystem::path> files_;
  size_t next_ = 0;
};

class VideoSource : public FrameSource {
 public:
  VideoSource(const std::string& file, const CameraRequest& camera) : camera_(camera), file_(file) {
    const auto level = cv::utils::logging::setLogLevel(cv::utils::logging::LOG_LEVEL_SILENT);
    if (std::filesystem::exists(file)) capture_.open(file, cv::CAP_FFMPEG);
    cv::utils::logging::setLogLevel(level);
    if (!capture_.isOpened())
      throw std::runtime_error(file + ": there is no such video, or none that OpenCV reads");
    const double fps = capture_.get(cv::CAP_PROP_FPS);
    if (!(fps > 0)) throw std::runtime_error(file + ": this video does not say its rate");
    period_us_ = 1e6 / fps;
    DemandSize(file, camera, static_cast<int>(capture_.get(cv::CAP_PROP_FRAME_WIDTH)),
               static_cast<int>(capture_.get(cv::CAP_PROP_FRAME_HEIGHT)));
  }

  Grab Next(Frame& out) override {
    if (!capture_.read(bgr_) || bgr_.empty()) return Grab::kEnd;
    out.frame_seq = ++seq_;
    out.exposure_us = std::llround(static_cast<double>(seq_) * period_us_);
    cv::cvtColor(bgr_, out.rgb, cv::COLOR_BGR2RGB);
    return Grab::kFrame;
  }

 private:
  const CameraRequest camera_;
  const std::string file_;
  cv::VideoCapture capture_;
  cv::Mat bgr_;
  double period_us_ = 0;
  int64_t seq_ = 0;
};

class Reconnecting : public FrameSource {
 public:
  using Open = std::function<std::unique_ptr<FrameSource>()>;

  Reconnecting(const std::string& camera, Open open, std::function<void(const std::string&)> say)
      : camera_(camera), open_(std::move(open)), say_(std::move(say)), source_(open_()) {}

  Grab Next(Frame& out) override {
    if (source_) {
      try {
        return source_->Next(out);
      } catch (const std::exception& e) {
        source_.reset();
        retry_ = kFirstRetry;
        retry_at_ = steady_clock::now() + retry_;
        say_("camera " + camera_ + ": " + e.what() + "; it is looked for");
      }
      return Grab::kLost;
    }
    if (steady_clock::now() < retry_at_) {
      std::this_thread::sleep_until(std::min(retry_at_, steady_clock::now() + kPatience));
      return Grab::kLost;
    }
    try {
      source_ = open_();
      say_("camera " + camera_ + " is back");
    } catch (const std::exception&) {
      retry_ = std::min(2 * retry_, kLastRetry);
      retry_at_ = steady_clock::now() + retry_;
    }
    return Grab::kLost;
  }

 private:
  const std::string camera_;
  const Open open_;
  const std::function<void(const std::string&)> say_;
  std::unique_ptr<FrameSource> source_;
  milliseconds retry_ = kFirstRetry;
  steady_clock::time_point retry_at_;
};

struct Spec {
  std::string kind, where;
};

Spec Parse(const std::string& spec) {
  const size_t colon = spec.find(':');
  const Spec s{spec.substr(0, colon), colon == std::string::npos ? "" : spec.substr(colon + 1)};
  for (const char* kind : {"ring", "v4l2", "realsense", "folder", "video"}) {
    if (colon != std::string::npos && s.kind == kind && (!s.where.empty() || s.kind == "realsense")) return s;
  }
  throw std::runtime_error("source \"" + spec +
                           "\": give ring:/NAME, v4l2:DEVICE, realsense:SERIAL, folder:DIR or video:FILE");
}

}  // namespace

bool IsRecording(const std::string& spec) {
  const std::string kind = Parse(spec).kind;
  return kind == "folder" || kind == "video";
}

std::unique_ptr<FrameSource> OpenSource(const std::string& spec, const CameraRequest& camera,
                                        std::function<void(const std::string&)> say) {
  const auto [kind, where] = Parse(spec);
  if (kind == "folder") return std::make_unique<FolderSource>(where, camera);
  if (kind == "video") return std::make_unique<VideoSource>(where, camera);
  return std::make_unique<Reconnecting>(
      camera.name,
      [kind = kind, where = where, camera]() -> std::unique_ptr<FrameSource> {
        if (kind == "ring") return std::make_unique<RingSource>(where, camera);
        if (kind == "v4l2") return std::make_unique<V4l2Source>(where, camera);
        return OpenRealSense(where, camera);
      },
      std::move(say));
}

}  // namespace intabs
