#include "intabs/perception/camera_model.h"

#include <opencv2/calib3d.hpp>
#include <vector>

namespace intabs {

Eigen::Vector2d CameraModel::Distort(const Eigen::Vector2d& ideal) const {
  if (!distorted()) return ideal;
  if (!(ideal.x() > -0.5 * width && ideal.x() < 1.5 * width && ideal.y() > -0.5 * height &&
        ideal.y() < 1.5 * height)) {
    return ideal;
  }
  const auto& [k1, k2, p1, p2, k3] = distortion;
  const double x = (ideal.x() - cx) / fx, y = (ideal.y() - cy) / fy;
  const double r2 = x * x + y * y;
  const double radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3));
  return {fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + cx,
          fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + cy};
}

Eigen::Vector2d CameraModel::Undistort(const Eigen::Vector2d& uv) const {
  if (!distorted()) return uv;
  const cv::Matx33d K(fx, 0, cx, 0, fy, cy, 0, 0, 1);
  const std::vector<cv::Point2d> in{{uv.x(), uv.y()}};
  std::vector<cv::Point2d> out;
  const cv::TermCriteria precise(cv::TermCriteria::COUNT | cv::TermCriteria::EPS, 100, 1e-9);
  cv::undistortPoints(in, out, K, std::vector<double>(distortion.begin(), distortion.end()), cv::noArray(), K,
                      precise);
  return {out[0].x, out[0].y};
}

}  // namespace intabs
