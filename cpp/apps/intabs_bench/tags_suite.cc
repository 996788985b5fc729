// tags: five tags (one of them the ground's) that move before clutter, 1280 x 720, one camera, one thread.
// track_frame: Pipeline, a frame at a time: tags, poses, tracks. track_detect: the tag detector alone.
// track_frame_cpu, library_cpu: in CPU time, for machines that others use too.
// scan: a frame that is also searched for new tags. library: AprilTag 3 on the same frames, whole, at full
// resolution.
#include <cmath>
#include <cstdlib>
#include <ctime>
#include <opencv2/core.hpp>
#include <opencv2/imgproc.hpp>
#include <stdexcept>
#include <string>

#include "intabs/perception/pipeline.h"
#include "suite.h"

extern "C" {
#include <apriltag/apriltag.h>
#include <apriltag/tag36h11.h>
}

namespace intabs::bench {
namespace {

constexpr int kFrames = 60;
constexpr int64_t kFrameUs = 33333;
constexpr double kSize = 0.05;  // m

cv::Mat Picture(int id) {
  apriltag_family_t* family = tag36h11_create();
  image_u8_t* image = apriltag_to_image(family, id);
  cv::Mat big;
  cv::resize(cv::Mat(image->height, image->width, CV_8UC1, image->buf, static_cast<size_t>(image->stride)),
             big, {}, 16, 16, cv::INTER_NEAREST);
  std::free(image->buf);
  std::free(image);
  tag36h11_destroy(family);
  return big;
}

PerceptionConfig Config() {
  PerceptionConfig config;
  CameraModel camera;
  camera.name = "camera";
  camera.width = 1280;
  camera.height = 720;
  camera.fx = camera.fy = 915;
  camera.cx = 639.5;
  camera.cy = 359.5;
  camera.X_WC = Pose{};
  config.cameras = {camera};
  for (int i = 0; i < 4; ++i)
    config.objects.push_back({i, i, "o" + std::to_string(i), {{10 + i, kSize, Pose{}}}});
  config.ground = GroundTag{0, 2 * kSize, {{0, 0.14, 0.9}, Eigen::Quaterniond::Identity()}};
  return config;
}

Pose ObjectAt(int object, int frame) {
  const double t = frame / 30.0, phase = 1.7 * object;
  return {{-0.3 + 0.2 * object + 0.05 * std::sin(2 * t + phase), -0.08 + 0.05 * std::cos(2 * t + phase),
           0.75 + 0.1 * std::sin(t + phase)},
          ExpSO3({0.5 * std::sin(t + phase), 0.5 * std::cos(t + phase), 0.4 * t + phase})};
}

void Draw(cv::Mat& image, const CameraModel& camera, const Pose& X_CT, int id, double size) {
  const cv::Mat picture = Picture(id);
  const float m = static_cast<float>(picture.cols);
  const double h = size / 2 * 1.25;  // with its white border
  const std::vector<cv::Point2f> from{{-.5f, -.5f}, {m - .5f, -.5f}, {m - .5f, m - .5f}, {-.5f, m - .5f}};
  std::vector<cv::Point2f> to;
  for (const Eigen::Vector3d& p : {Eigen::Vector3d(-h, -h, 0), {h, -h, 0}, {h, h, 0}, {-h, h, 0}}) {
    const Eigen::Vector2d uv = camera.Project(X_CT * p);
    to.emplace_back(static_cast<float>(uv.x()), static_cast<float>(uv.y()));
  }
  cv::Mat warped, mask;
  const cv::Mat M = cv::getPerspectiveTransform(from, to);
  cv::warpPerspective(picture, warped, M, image.size(), cv::INTER_AREA);
  cv::warpPerspective(cv::Mat(picture.size(), CV_8UC1, cv::Scalar(255)), mask, M, image.size());
  warped.copyTo(image, mask > 127);
}

std::vector<cv::Mat> Film(const PerceptionConfig& config) {
  cv::RNG rng(7);
  cv::Mat clutter(720, 1280, CV_8UC1, cv::Scalar(120));
  for (int i = 0; i < 120; ++i) {
    const cv::Point at(rng.uniform(0, 1280), rng.uniform(0, 720));
    const cv::Point size(rng.uniform(10, 90), rng.uniform(10, 90));
    cv::rectangle(clutter, at, at + size, cv::Scalar(rng.uniform(40, 220)), -1);
  }
  std::vector<cv::Mat> film;
  for (int f = 0; f < kFrames; ++f) {
    cv::Mat image = clutter.clone(), noise(image.size(), CV_32F);
    const CameraModel& camera = config.cameras[0];
    Draw(image, camera, config.ground->X_WT, config.ground->id, config.ground->size);
    for (int i = 0; i < 4; ++i) Draw(image, camera, ObjectAt(i, f), 10 + i, kSize);
    image.convertTo(image, CV_32F, 0.8, 20);
    cv::GaussianBlur(image, image, {}, 0.8);
    rng.fill(noise, cv::RNG::NORMAL, 0, 3);
    image += noise;
    image.convertTo(image, CV_8UC1);
    film.push_back(image);
  }
  return film;
}

}  // namespace

Report Tags(const Options& options) {
  cv::setNumThreads(1);
  const PerceptionConfig config = Config();
  const std::vector<cv::Mat> film = Film(config);
  Pipeline pipeline(config);
  LibraryDetector library;
  ObjectPoses poses;
  CameraDetections seen;
  Report report;
  int valid = 0;
  for (int round = 0; round < options.rounds; ++round) {
    pipeline.Reset();
    pipeline.Process({film[0]}, 1, 0, poses, seen);
    Samples &track = report.rows["track_frame"], &alone = report.rows["track_detect"];
    track.StartRound(kFrames);
    alone.StartRound(kFrames);
    Samples& busy = report.rows["track_frame_cpu"];
    busy.StartRound(kFrames);
    for (int f = 1; f < kFrames; ++f) {
      const std::clock_t cpu = std::clock();
      const auto start = std::chrono::steady_clock::now();
      pipeline.Process({film[f]}, f + 1, f * kFrameUs, poses, seen);
      track.Add(std::chrono::duration<double, std::micro>(std::chrono::steady_clock::now() - start).count());
      alone.Add(pipeline.detect_us(0));
      busy.Add(1e6 * static_cast<double>(std::clock() - cpu) / CLOCKS_PER_SEC);
      for (const TrackedObject& o : poses.objects) {
        valid += o.valid && o.age == 0 && (o.X_WO.p - ObjectAt(o.id, f).p).norm() < 0.005;
      }
    }
    int f = 0;
    Samples& library_cpu = report.rows["library_cpu"];
    library_cpu.StartRound(kFrames);
    Measure(report.rows["library"], kFrames / 4, [&] {
      const std::clock_t cpu = std::clock();
      library.Detect(film[f++ % kFrames]);
      library_cpu.Add(1e6 * static_cast<double>(std::clock() - cpu) / CLOCKS_PER_SEC);
    });
    TagDetector scanner({});
    scanner.Detect(film[0], {}, true);
    int s = 0;
    Measure(report.rows["scan"], kFrames / 4, [&] { scanner.Detect(film[s++ % kFrames], {}, true); });
  }
  const int all = options.rounds * (kFrames - 1) * 4;
  if (valid < 0.99 * all) {
    throw std::runtime_error("only " + std::to_string(valid) + " of " + std::to_string(all) +
                             " poses were right: the times would mean nothing");
  }
  for (const char* row : {"track_frame", "track_detect", "scan"}) {
    report.ratios[row] = report.rows[row].BestMedian() / report.rows["library"].BestMedian();
  }
  report.notes.push_back(std::to_string(valid) + " of " + std::to_string(all) + " poses within 5 mm");
  return report;
}

}  // namespace intabs::bench
