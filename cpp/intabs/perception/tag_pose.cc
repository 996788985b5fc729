#include "intabs/perception/tag_pose.h"

#include <opencv2/calib3d.hpp>
#include <utility>
#include <vector>

namespace intabs {
namespace {

// The pose that looks the same under weak perspective: the tag's x and y axes keep what they show to the
// camera and lose the sign of their depth along the line of sight.
Pose Mirror(const Pose& X_CT) {
  const Eigen::Vector3d s = X_CT.p.normalized();
  const Eigen::Matrix3d R = (Eigen::Matrix3d::Identity() - 2 * s * s.transpose()) *
                            X_CT.q.toRotationMatrix() * Eigen::Vector3d(1, 1, -1).asDiagonal();
  return {X_CT.p, Eigen::Quaterniond(R).normalized()};
}

}  // namespace

TagPose SolveTag(const CameraModel& camera, double size, const TagCorners& corners) {
  TagPose out;
  for (const Eigen::Vector2d& c : corners) {
    if (!c.allFinite()) return out;
  }
  // IPPE_SQUARE wants x right, y up, z out of the tag, from the top left corner on, clockwise.
  const double h = size / 2;
  const std::array<cv::Point3d, 4> square{{{-h, h, 0}, {h, h, 0}, {h, -h, 0}, {-h, -h, 0}}};
  std::array<cv::Point2d, 4> normalised;  // of a camera with f = 1
  for (int i = 0; i < 4; ++i) {
    const Eigen::Vector2d& c = corners[3 - i];
    normalised[i] = {(c.x() - camera.cx) / camera.fx, (c.y() - camera.cy) / camera.fy};
  }
  std::vector<cv::Vec3d> rvecs, tvecs;
  try {
    cv::solvePnPGeneric(square, normalised, cv::Matx33d::eye(), cv::noArray(), rvecs, tvecs, false,
                        cv::SOLVEPNP_IPPE_SQUARE);
  } catch (const cv::Exception&) {  // collinear corners
    return out;
  }

  const PlacedCamera here{&camera, Pose{}};
  const std::array<Eigen::Vector3d, 4> points_T = TagPoints(size);
  std::array<PointView, 4> views;
  for (int i = 0; i < 4; ++i) views[i] = {points_T[i], corners[i], 0};
  const auto fit = [&](const Pose& start) { return FitPose({&here, 1}, views, start); };

  std::array<PoseFit, 2> fits;
  for (size_t i = 0; i < std::min<size_t>(2, rvecs.size()); ++i) {
    cv::Matx33d R;
    cv::Rodrigues(rvecs[i], R);
    Eigen::Matrix3d R_CT;  // y up, z out -> y down, z in
    R_CT << R(0, 0), -R(0, 1), -R(0, 2), R(1, 0), -R(1, 1), -R(1, 2), R(2, 0), -R(2, 1), -R(2, 2);
    if (R_CT.allFinite()) {
      fits[i] = fit({{tvecs[i][0], tvecs[i][1], tvecs[i][2]}, Eigen::Quaterniond(R_CT).normalized()});
    }
  }
  if (!fits[0].ok) std::swap(fits[0], fits[1]);
  if (!fits[0].ok) return out;
  if (!fits[1].ok) fits[1] = fit(Mirror(fits[0].X_WO));
  if (!fits[1].ok) fits[1] = fits[0];
  if (fits[1].rms_px < fits[0].rms_px) std::swap(fits[0], fits[1]);
  out.ok = true;
  for (int i = 0; i < 2; ++i) {
    out.X_CT[i] = fits[i].X_WO;
    out.reprojection_px[i] = fits[i].rms_px;
  }
  out.ambiguity = fits[1].rms_px > 0 ? fits[0].rms_px / fits[1].rms_px : 1.0;
  return out;
}

}  // namespace intabs
