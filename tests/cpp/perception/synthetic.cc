#include "perception/synthetic.h"

extern "C" {
#include <apriltag/apriltag.h>
#include <apriltag/tag36h11.h>
}

#include <algorithm>
#include <cstdlib>
#include <opencv2/imgproc.hpp>
#include <vector>

namespace intabs::test {
namespace {

constexpr int kCell = 32;  // px of the texture a cell
constexpr int kSuper = 3;  // supersampling

cv::Mat Texture(int id) {
  TagPattern pattern = Pattern(id);
  cv::Mat small(10, 10, CV_32F, pattern.data()), big;
  small.convertTo(small, CV_8UC1, 255);
  cv::resize(small, big, {}, kCell, kCell, cv::INTER_NEAREST);
  return big;
}

}  // namespace

TagPattern Pattern(int id) {
  apriltag_family_t* family = tag36h11_create();
  image_u8_t* image = apriltag_to_image(family, id);
  TagPattern pattern;
  for (int k = 0; k < 100; ++k) pattern[k] = image->buf[k / 10 * image->stride + k % 10] > 127;
  std::free(image->buf);
  std::free(image);
  tag36h11_destroy(family);
  return pattern;
}

CameraModel VgaCamera(const std::string& name, const Pose& X_WC) {
  CameraModel camera;
  camera.name = name;
  camera.width = 640;
  camera.height = 480;
  camera.fx = camera.fy = 610;
  camera.cx = 319.5;
  camera.cy = 239.5;
  camera.X_WC = X_WC;
  return camera;
}

Pose LookAt(const Eigen::Vector3d& eye, const Eigen::Vector3d& target) {
  Eigen::Matrix3d R;
  R.col(2) = (target - eye).normalized();
  R.col(0) = R.col(2).cross(Eigen::Vector3d::UnitZ()).normalized();
  R.col(1) = R.col(2).cross(R.col(0));
  return {eye, Eigen::Quaterniond(R)};
}

cv::Mat View(const CameraModel& camera, const Scene& scene, uint64_t seed, const Quality& quality) {
  cv::RNG rng(seed);
  const cv::Size big(camera.width * kSuper, camera.height * kSuper);
  cv::Mat image(big, CV_8UC1, cv::Scalar(120));
  for (int i = 0; i < 60; ++i) {
    const cv::Point at(rng.uniform(0, big.width), rng.uniform(0, big.height));
    const cv::Point size(rng.uniform(10 * kSuper, 90 * kSuper), rng.uniform(10 * kSuper, 90 * kSuper));
    cv::rectangle(image, at, at + size, cv::Scalar(rng.uniform(40, 220)), -1);
  }
  std::vector<std::pair<double, int>> order;  // far ones first
  for (const auto& [id, tag] : scene) {
    const Pose X_CT = camera.X_WC->Inverse() * tag.X_WT;
    const bool faces = (X_CT.q * Eigen::Vector3d::UnitZ()).dot(X_CT.p) > 0;
    if (faces && X_CT.p.z() > 0.05) order.push_back({-X_CT.p.z(), id});
  }
  std::sort(order.begin(), order.end());
  for (const auto& [depth, id] : order) {
    const Pose X_CT = camera.X_WC->Inverse() * scene.at(id).X_WT;
    const cv::Mat texture = Texture(id);
    const float m = static_cast<float>(texture.cols);
    const double h = scene.at(id).size / 2 * 10 / 8;
    std::vector<cv::Point2f> from{{-.5f, -.5f}, {m - .5f, -.5f}, {m - .5f, m - .5f}, {-.5f, m - .5f}};
    std::vector<cv::Point2f> to;
    for (const Eigen::Vector3d& p : {Eigen::Vector3d(-h, -h, 0), {h, -h, 0}, {h, h, 0}, {-h, h, 0}}) {
      const Eigen::Vector2d uv = camera.Project(X_CT * p);
      to.emplace_back((uv.x() + .5) * kSuper - .5, (uv.y() + .5) * kSuper - .5);
    }
    const cv::Rect box = cv::boundingRect(to) & cv::Rect({}, big);
    if (box.empty()) continue;
    for (cv::Point2f& p : to) p -= cv::Point2f(box.tl());
    const cv::Mat M = cv::getPerspectiveTransform(from, to);
    cv::Mat warped, mask;
    cv::warpPerspective(texture, warped, M, box.size(), cv::INTER_AREA);
    cv::warpPerspective(cv::Mat(texture.size(), CV_8UC1, cv::Scalar(255)), mask, M, box.size());
    warped.copyTo(image(box), mask > 127);
  }
  cv::Mat small, noise(camera.height, camera.width, CV_32F);
  cv::resize(image, small, {camera.width, camera.height}, 0, 0, cv::INTER_AREA);
  small.convertTo(small, CV_32F, 0.8, 20);
  cv::GaussianBlur(small, small, {}, quality.blur_px);
  rng.fill(noise, cv::RNG::NORMAL, 0, quality.noise);
  small += noise;
  small.convertTo(small, CV_8UC1);
  return small;
}

}  // namespace intabs::test
