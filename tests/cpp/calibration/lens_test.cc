// Distortion in the camera model and through the pipeline.
#include <catch2/catch.hpp>
#include <opencv2/calib3d.hpp>
#include <opencv2/imgproc.hpp>
#include <random>

#include "intabs/perception/pipeline.h"
#include "perception/synthetic.h"

namespace intabs {
namespace {

constexpr std::array<double, 5> kLens{-0.28, 0.09, 0.0011, -0.0007, -0.012};

CameraModel Lens() {
  CameraModel c = test::VgaCamera("left", Pose{});
  c.distortion = kLens;
  return c;
}

// The picture that a lens makes of what an ideal camera sees.
cv::Mat ThroughLens(const cv::Mat& ideal, const CameraModel& camera) {
  cv::Mat map(ideal.size(), CV_32FC2), out;
  for (int y = 0; y < map.rows; ++y) {
    for (int x = 0; x < map.cols; ++x) {
      const Eigen::Vector2d uv = camera.Undistort(Eigen::Vector2d(x, y));
      map.at<cv::Vec2f>(y, x) = {static_cast<float>(uv.x()), static_cast<float>(uv.y())};
    }
  }
  cv::remap(ideal, out, map, cv::noArray(), cv::INTER_CUBIC, cv::BORDER_REPLICATE);
  return out;
}

}  // namespace

TEST_CASE("Distortion is OpenCV's, and is undone to 1e-6 px all over the picture") {
  const CameraModel camera = Lens();
  const cv::Matx33d K(camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1);
  std::mt19937 random(1);
  std::uniform_real_distribution<double> x(0, camera.width), y(0, camera.height);
  for (int i = 0; i < 300; ++i) {
    const Eigen::Vector2d uv(x(random), y(random));
    CAPTURE(uv.transpose());
    const Eigen::Vector2d ideal = camera.Undistort(uv);
    CHECK((camera.Distort(ideal) - uv).norm() < 1e-6);
    const std::vector<cv::Point3d> points{
        {(ideal.x() - camera.cx) / camera.fx, (ideal.y() - camera.cy) / camera.fy, 1}};
    std::vector<cv::Point2d> projected;
    cv::projectPoints(points, cv::Vec3d(), cv::Vec3d(), K, std::vector<double>(kLens.begin(), kLens.end()),
                      projected);
    CHECK(std::hypot(projected[0].x - uv.x(), projected[0].y - uv.y()) < 1e-6);
  }
}

TEST_CASE("Without distortion pixels stay what they are, bit for bit; far outside they do so with it") {
  CameraModel camera = Lens();
  const Eigen::Vector2d far(-0.6 * camera.width, 17.25);
  CHECK(camera.Distort(far) == far);
  camera.distortion = {};
  const Eigen::Vector2d uv(123.456, 78.9);
  CHECK(camera.Undistort(uv) == uv);
  CHECK(camera.Distort(uv) == uv);
}

TEST_CASE("Through a distorting lens objects are found where they are, when the lens is known") {
  const Pose X_WC = test::LookAt({0.75, -0.35, 0.5}, {0.45, 0, 0});
  CameraModel camera = Lens();
  camera.X_WC.reset();  // the ground tag shows it
  PerceptionConfig config;
  config.ground = GroundTag{0, 0.12, {{0.5, 0.05, 0}, {0, 1, 0, 0}}};
  ObjectModel block{0, 0, "block", {}};
  block.tags.push_back({10, 0.05, Pose{}});
  config.objects.push_back(block);

  const auto error_m = [&](bool lens_is_known) {
    config.cameras = {camera};
    if (!lens_is_known) config.cameras[0].distortion = {};
    Pipeline pipeline(config);
    ObjectPoses poses;
    CameraDetections seen;
    double worst = 0;
    for (int i = 0; i < 12; ++i) {
      const Pose X_WO{{0.36 + 0.02 * i, -0.2 + 0.008 * i, 0.02}, {0, 1, 0, 0}};
      const CameraModel ideal = test::VgaCamera("left", X_WC);
      const cv::Mat picture =
          ThroughLens(test::View(ideal, {{0, {config.ground->X_WT, 0.12}}, {10, {X_WO, 0.05}}}, i), camera);
      pipeline.Process({picture}, i + 1, 40000 * (i + 1), poses, seen);
      if (i < 2) continue;
      REQUIRE(poses.objects[0].id == 0);
      REQUIRE(poses.objects[0].age == 0);
      worst = std::max(worst, (poses.objects[0].X_WO.p - X_WO.p).norm());
      // The message has the corners of the picture.
      for (int t = 0; t < seen[0].n; ++t) {
        if (seen[0].tags[t].id != 10) continue;
        const Eigen::Vector3d p_C = X_WC.Inverse() * (X_WO * TagPoints(0.05)[0]);
        CHECK((seen[0].tags[t].corners[0].cast<double>() - camera.Distort(camera.Project(p_C))).norm() < 1.5);
      }
    }
    return worst;
  };
  const double known = error_m(true), unknown = error_m(false);
  CAPTURE(known, unknown);
  CHECK(known < 0.003);
  CHECK(unknown > 3 * known);
}

}  // namespace intabs
