#include "intabs/perception/calibration.h"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <numeric>
#include <opencv2/aruco/charuco.hpp>
#include <opencv2/calib3d.hpp>
#include <opencv2/imgproc.hpp>
#include <stdexcept>

#include "intabs/perception/tag_pose.h"

namespace intabs {
namespace {

constexpr double kDegree = M_PI / 180;
constexpr int kMinBoards = 8, kMinGroundFrames = 10, kMinSamples = 8;
constexpr int kCellsX = 8, kCellsY = 6;
constexpr double kMinCoverage = 0.4;
constexpr double kMinTilt = 15 * kDegree;
constexpr double kMinTagPx = 20;
constexpr double kStillPx = 1;  // a frame whose corners are further off their median was taken elsewhere
constexpr double kMinTurn = 30 * kDegree;
constexpr double kMinSpread = 0.1;
constexpr double kOutlier = 3;  // times the median

[[noreturn]] void Refuse(const std::string& what) { throw std::runtime_error(what); }

std::string Number(double v, const char* format = "%.2f") {
  char text[64];
  std::snprintf(text, sizeof(text), format, v);
  return text;
}

double Median(std::vector<double> v) {
  std::nth_element(v.begin(), v.begin() + v.size() / 2, v.end());
  return v[v.size() / 2];
}

double RmsDistance(const TagCorners& a, const TagCorners& b) {
  double sum = 0;
  for (int k = 0; k < 4; ++k) sum += (a[k] - b[k]).squaredNorm();
  return std::sqrt(sum / 4);
}

cv::Ptr<cv::aruco::CharucoBoard> MakeCharuco(const Board& b) {
  return cv::aruco::CharucoBoard::create(b.columns, b.rows, static_cast<float>(b.square),
                                         static_cast<float>(b.marker),
                                         cv::aruco::getPredefinedDictionary(cv::aruco::DICT_6X6_250));
}

// --- Intrinsics

struct Fit {
  cv::Mat K, distortion;
  std::vector<cv::Mat> rvecs, tvecs;
  std::vector<double> view_rms;
  double rms = 0, k3_sigma = 0;
};

Fit FitLens(const std::vector<const BoardView*>& views, cv::Size size, bool with_k3) {
  std::vector<std::vector<cv::Point3f>> points;
  std::vector<std::vector<cv::Point2f>> corners;
  for (const BoardView* v : views) {
    points.push_back(v->points);
    corners.push_back(v->corners);
  }
  Fit fit;
  cv::Mat sigma, sigma_views, view_rms;
  fit.rms = cv::calibrateCamera(points, corners, size, fit.K, fit.distortion, fit.rvecs, fit.tvecs, sigma,
                                sigma_views, view_rms, with_k3 ? 0 : cv::CALIB_FIX_K3);
  for (int i = 0; i < view_rms.rows; ++i) fit.view_rms.push_back(view_rms.at<double>(i));
  fit.k3_sigma = sigma.at<double>(8);  // fx fy cx cy k1 k2 p1 p2 k3
  return fit;
}

double HeldOutRms(const std::vector<const BoardView*>& views, cv::Size size, bool with_k3) {
  constexpr int kFolds = 5;
  double sum = 0;
  size_t n = 0;
  for (int fold = 0; fold < kFolds; ++fold) {
    std::vector<const BoardView*> kept, held;
    for (size_t i = 0; i < views.size(); ++i)
      (static_cast<int>(i % kFolds) == fold ? held : kept).push_back(views[i]);
    const Fit fit = FitLens(kept, size, with_k3);
    for (const BoardView* v : held) {
      cv::Mat rvec, tvec;
      std::vector<cv::Point2f> projected;
      cv::solvePnP(v->points, v->corners, fit.K, fit.distortion, rvec, tvec);
      cv::projectPoints(v->points, rvec, tvec, fit.K, fit.distortion, projected);
      for (size_t k = 0; k < projected.size(); ++k)
        sum += std::pow(cv::norm(projected[k] - v->corners[k]), 2);
      n += projected.size();
    }
  }
  return std::sqrt(sum / static_cast<double>(n));
}

double Coverage(const std::vector<const BoardView*>& views, cv::Size size) {
  std::array<bool, kCellsX * kCellsY> seen{};
  for (const BoardView* v : views) {
    for (const cv::Point2f& c : v->corners) {
      const int x = std::clamp(static_cast<int>(kCellsX * c.x / size.width), 0, kCellsX - 1);
      const int y = std::clamp(static_cast<int>(kCellsY * c.y / size.height), 0, kCellsY - 1);
      seen[y * kCellsX + x] = true;
    }
  }
  return std::count(seen.begin(), seen.end(), true) / static_cast<double>(seen.size());
}

}  // namespace

std::optional<BoardView> FindBoard(const cv::Mat& gray, const Board& board) {
  BoardView view;
  if (board.marker > 0) {
    const auto charuco = MakeCharuco(board);
    std::vector<std::vector<cv::Point2f>> markers;
    std::vector<int> marker_ids, ids;
    cv::aruco::detectMarkers(gray, charuco->dictionary, markers, marker_ids);
    if (marker_ids.empty()) return std::nullopt;
    cv::aruco::interpolateCornersCharuco(markers, marker_ids, gray, charuco, view.corners, ids);
    if (ids.size() < 8) return std::nullopt;
    // Its own refinement leaves up to half a pixel.
    cv::cornerSubPix(gray, view.corners, {4, 4}, {-1, -1},
                     {cv::TermCriteria::COUNT | cv::TermCriteria::EPS, 100, 1e-4});
    for (const int id : ids) view.points.push_back(charuco->chessboardCorners[id]);
    return view;
  }
  const cv::Size size(board.columns, board.rows);
  if (!cv::findChessboardCornersSB(
          gray, size, view.corners,
          cv::CALIB_CB_NORMALIZE_IMAGE | cv::CALIB_CB_EXHAUSTIVE | cv::CALIB_CB_ACCURACY)) {
    view.corners.clear();
    if (!cv::findChessboardCorners(gray, size, view.corners)) return std::nullopt;
    cv::cornerSubPix(gray, view.corners, {5, 5}, {-1, -1},
                     {cv::TermCriteria::COUNT | cv::TermCriteria::EPS, 50, 1e-3});
  }
  for (int y = 0; y < board.rows; ++y) {
    for (int x = 0; x < board.columns; ++x)
      view.points.emplace_back(static_cast<float>(x * board.square), static_cast<float>(y * board.square),
                               0.f);
  }
  return view;
}

Intrinsics CalibrateIntrinsics(const std::vector<BoardView>& all, cv::Size size, double max_rms_px) {
  const auto demand_enough = [](size_t n) {
    if (n < kMinBoards) {
      Refuse("the board is usable in " + std::to_string(n) + " pictures, needed are " +
             std::to_string(kMinBoards) +
             ": take more, the whole board in view (and check its number of corners)");
    }
  };
  demand_enough(all.size());
  std::vector<const BoardView*> views;
  for (const BoardView& v : all) views.push_back(&v);

  Intrinsics out;
  const double coverage = Coverage(views, size);
  if (coverage < kMinCoverage) {
    Refuse("the boards cover " + Number(100 * coverage, "%.0f") + " % of the picture, needed are " +
           Number(100 * kMinCoverage, "%.0f") +
           " %: take pictures with the board in the corners and at the edges");
  }
  Fit fit = FitLens(views, size, false);
  const double bar = std::max(kOutlier * Median(fit.view_rms), max_rms_px);
  std::vector<const BoardView*> kept;
  for (size_t i = 0; i < views.size(); ++i) {
    if (fit.view_rms[i] <= bar) {
      kept.push_back(views[i]);
    } else {
      out.dropped.push_back(views[i]->name);
    }
  }
  demand_enough(kept.size());
  fit = FitLens(kept, size, true);
  const bool with_k3 = std::abs(fit.distortion.at<double>(4)) > 3 * fit.k3_sigma;
  if (!with_k3) fit = FitLens(kept, size, false);

  for (const cv::Mat& rvec : fit.rvecs) {
    cv::Mat R;
    cv::Rodrigues(rvec, R);
    out.tilt = std::max(out.tilt, std::acos(std::min(1.0, std::abs(R.at<double>(2, 2)))));
  }
  if (out.tilt < kMinTilt) {
    Refuse("the board is never tilted by more than " + Number(out.tilt / kDegree, "%.0f") +
           " deg: focal length and distance look alike then; tilt it by 20 to 45 deg, to each side");
  }
  if (!(fit.rms <= max_rms_px)) {
    Refuse("the corners are off by " + Number(fit.rms) + " px (RMS), allowed are " + Number(max_rms_px) +
           ": is the board flat, are the pictures sharp, all from one camera with one focus?");
  }
  out.rms_px = fit.rms;
  out.held_out_rms_px = HeldOutRms(kept, size, with_k3);
  out.coverage = Coverage(kept, size);
  out.views = static_cast<int>(kept.size());
  out.model.width = size.width;
  out.model.height = size.height;
  out.model.fx = fit.K.at<double>(0, 0);
  out.model.fy = fit.K.at<double>(1, 1);
  out.model.cx = fit.K.at<double>(0, 2);
  out.model.cy = fit.K.at<double>(1, 2);
  for (int i = 0; i < 5; ++i) out.model.distortion[i] = fit.distortion.at<double>(i);
  return out;
}

// --- Extrinsics

Extrinsics CalibrateExtrinsics(const CameraModel& camera, const GroundTag& ground,
                               const std::vector<TagCorners>& frames) {
  const std::string who = "camera " + camera.name + ": ";
  const auto demand_enough = [&](size_t n, const std::string& how) {
    if (n < kMinGroundFrames) {
      Refuse(who + std::to_string(n) + " frames show the ground tag (id " + std::to_string(ground.id) + ")" +
             how + ", needed are " + std::to_string(kMinGroundFrames));
    }
  };
  demand_enough(frames.size(), "");
  TagCorners median;
  for (int k = 0; k < 4; ++k) {
    for (int i = 0; i < 2; ++i) {
      std::vector<double> v;
      for (const TagCorners& f : frames) v.push_back(f[k][i]);
      median[k][i] = Median(v);
    }
  }
  std::vector<const TagCorners*> kept;
  for (const TagCorners& f : frames) {
    if (RmsDistance(f, median) <= kStillPx) kept.push_back(&f);
  }
  if (5 * kept.size() < 4 * frames.size()) {
    Refuse(who + std::to_string(frames.size() - kept.size()) + " of " + std::to_string(frames.size()) +
           " frames show the ground tag elsewhere: camera and tag must stand still");
  }
  demand_enough(kept.size(), " in one place");

  Extrinsics out;
  out.frames = static_cast<int>(kept.size());
  TagCorners mean;
  mean.fill(Eigen::Vector2d::Zero());
  for (const TagCorners* f : kept) {
    for (int k = 0; k < 4; ++k) mean[k] += (*f)[k] / static_cast<double>(kept.size());
  }
  for (const TagCorners* f : kept) out.spread_px += std::pow(RmsDistance(*f, mean), 2);
  out.spread_px = std::sqrt(out.spread_px / static_cast<double>(kept.size()));

  double side = 1e9;
  for (int k = 0; k < 4; ++k) side = std::min(side, (mean[k] - mean[(k + 1) % 4]).norm());
  if (side < kMinTagPx) {
    Refuse(who + "a side of the ground tag is " + Number(side, "%.0f") + " px long, needed are " +
           Number(kMinTagPx, "%.0f") + ": go nearer, or print it larger");
  }
  const TagPose pose = SolveTag(camera, ground.size, mean);
  if (!pose.ok) Refuse(who + "no pose explains the ground tag's corners");
  if (pose.ambiguity > 0.6 && AngleBetween(pose.X_CT[0].q, pose.X_CT[1].q) > 5 * kDegree) {
    Refuse(who + "two poses, " + Number(AngleBetween(pose.X_CT[0].q, pose.X_CT[1].q) / kDegree, "%.0f") +
           " deg apart, explain the ground tag alike (" + Number(pose.reprojection_px[0]) + " and " +
           Number(pose.reprojection_px[1]) + " px): go nearer, or look at it at 30 to 60 deg");
  }
  out.rms_px = pose.reprojection_px[0];
  if (!(out.rms_px <= 1)) {
    Refuse(who + "the ground tag's corners are off by " + Number(out.rms_px) +
           " px: are the intrinsics and the tag flat and right?");
  }
  out.X_WC = ground.X_WT * pose.X_CT[0].Inverse();

  // Covariance: corners err by what single frames scatter, but never by less than 0.02 px all together.
  const double sigma_px =
      std::max({out.spread_px / std::sqrt(2.0 * out.frames), out.rms_px / std::sqrt(2.0), 0.02});
  const std::vector<PlacedCamera> placed{{&camera, out.X_WC, {}}};
  std::vector<PointView> points;
  const auto tag_points = TagPoints(ground.size);
  for (int k = 0; k < 4; ++k) points.push_back({tag_points[k], mean[k], 0});
  const PoseFit fit = FitPose(placed, points, ground.X_WT);
  // Of the tag seen from the camera; about the camera's own place the lever adds to it.
  const Matrix6d covariance = fit.information.inverse() * sigma_px * sigma_px;
  const double distance = (ground.X_WT.p - out.X_WC.p).norm();
  const auto largest = [](const Eigen::Matrix3d& m) {
    return std::sqrt(Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d>(m).eigenvalues().maxCoeff());
  };
  out.sigma_rad = largest(covariance.topLeftCorner<3, 3>());
  out.sigma_m = std::hypot(largest(covariance.bottomRightCorner<3, 3>()), distance * out.sigma_rad);
  return out;
}

// --- Hand-eye

namespace {

// The tag in W from all cameras that see it.
std::optional<Pose> SeeTag(const std::vector<PlacedCamera>& cameras, double size,
                           const HandEyeSample& sample) {
  std::vector<PointView> points;
  std::vector<Pose> starts;
  const auto tag_points = TagPoints(size);
  for (const HandEyeSample::View& v : sample.views) {
    for (int k = 0; k < 4; ++k) points.push_back({tag_points[k], v.corners[k], v.camera});
    const TagPose pose = SolveTag(*cameras[v.camera].model, size, v.corners);
    if (!pose.ok) continue;
    for (const Pose& X_CT : pose.X_CT) starts.push_back(cameras[v.camera].X_WC * X_CT);
  }
  std::optional<Pose> best;
  double best_rms = 1e9;
  for (const Pose& start : starts) {
    const PoseFit fit = FitPose(cameras, points, start);
    if (!fit.ok || !(fit.rms_px < best_rms)) continue;
    best = fit.X_WO;
    best_rms = fit.rms_px;
  }
  return best;
}

using Vector12d = Eigen::Matrix<double, 12, 1>;
using Matrix12d = Eigen::Matrix<double, 12, 12>;

Pose Moved(const Pose& X, const Eigen::Vector3d& w, const Eigen::Vector3d& dp) {
  return {X.p + dp, (ExpSO3(w) * X.q).normalized()};
}

struct HandEyeFit {
  Pose X_WB, X_ET;
  Matrix12d information;
  std::vector<double> sample_rms;
  double cost = 0;  // sum of squares [px^2]
  int points = 0;
};

// Residuals [px] of a sample's corners, 2 a corner.
Eigen::VectorXd Residuals(const std::vector<PlacedCamera>& cameras, double size, const HandEyeSample& s,
                          const Pose& X_WB, const Pose& X_ET) {
  const auto tag_points = TagPoints(size);
  const Pose X_WT = X_WB * s.X_BE * X_ET;
  Eigen::VectorXd r(8 * s.views.size());
  int i = 0;
  for (const HandEyeSample::View& v : s.views) {
    const Pose X_CT = cameras[v.camera].X_WC.Inverse() * X_WT;
    for (int k = 0; k < 4; ++k, i += 2) {
      const Eigen::Vector3d p_C = X_CT * tag_points[k];
      r.segment<2>(i) = p_C.z() > 1e-3 ? Eigen::Vector2d(cameras[v.camera].model->Project(p_C) - v.corners[k])
                                       : Eigen::Vector2d(1e3, 1e3);
    }
  }
  return r;
}

void Refine(const std::vector<PlacedCamera>& cameras, double size,
            const std::vector<const HandEyeSample*>& samples, HandEyeFit& fit) {
  const auto evaluate = [&](HandEyeFit& f, Matrix12d* H, Vector12d* g) {
    f.cost = 0;
    f.points = 0;
    f.sample_rms.clear();
    if (H) H->setZero();
    if (H) g->setZero();
    for (const HandEyeSample* s : samples) {
      const Eigen::VectorXd r = Residuals(cameras, size, *s, f.X_WB, f.X_ET);
      f.cost += r.squaredNorm();
      f.points += static_cast<int>(r.size() / 2);
      f.sample_rms.push_back(std::sqrt(2 * r.squaredNorm() / static_cast<double>(r.size())));
      if (!H) continue;
      Eigen::MatrixXd J(r.size(), 12);
      constexpr double kStep = 1e-6;
      for (int k = 0; k < 12; ++k) {
        Eigen::Vector3d w = Eigen::Vector3d::Zero(), dp = w;
        (k % 6 < 3 ? w : dp)[k % 3] = kStep;
        const Pose X_WB = k < 6 ? Moved(f.X_WB, w, dp) : f.X_WB;
        const Pose X_ET = k < 6 ? f.X_ET : Moved(f.X_ET, w, dp);
        J.col(k) = (Residuals(cameras, size, *s, X_WB, X_ET) - r) / kStep;
      }
      *H += J.transpose() * J;
      *g += J.transpose() * r;
    }
  };
  Vector12d g;
  evaluate(fit, &fit.information, &g);
  double damping = 1e-3;
  for (int i = 0; i < 100 && damping < 1e9; ++i) {
    Matrix12d A = fit.information;
    A.diagonal() *= 1 + damping;
    const Vector12d step = A.ldlt().solve(-g);
    HandEyeFit next;
    next.X_WB = Moved(fit.X_WB, step.head<3>(), step.segment<3>(3));
    next.X_ET = Moved(fit.X_ET, step.segment<3>(6), step.tail<3>());
    Vector12d next_g;
    evaluate(next, &next.information, &next_g);
    if (next.cost <= fit.cost) {
      fit = next;
      g = next_g;
      damping = std::max(damping * 0.1, 1e-9);
      if (step.norm() < 1e-10) break;
    } else {
      damping *= 10;
    }
  }
}

cv::Mat Rotation(const Pose& X) {
  const Eigen::Matrix3d R = X.q.toRotationMatrix();
  cv::Mat m(3, 3, CV_64F);
  for (int i = 0; i < 3; ++i) {
    for (int k = 0; k < 3; ++k) m.at<double>(i, k) = R(i, k);
  }
  return m;
}
cv::Mat Translation(const Pose& X) { return (cv::Mat_<double>(3, 1) << X.p.x(), X.p.y(), X.p.z()); }
Pose ToPose(const cv::Mat& R, const cv::Mat& t) {
  Eigen::Matrix3d m;
  for (int i = 0; i < 3; ++i) {
    for (int k = 0; k < 3; ++k) m(i, k) = R.at<double>(i, k);
  }
  return {{t.at<double>(0), t.at<double>(1), t.at<double>(2)}, Eigen::Quaterniond(m).normalized()};
}

}  // namespace

HandEye CalibrateHandEye(const std::vector<PlacedCamera>& cameras, double tag_size,
                         const std::vector<HandEyeSample>& all, double max_rms_px) {
  HandEye out;
  std::vector<const HandEyeSample*> samples;
  std::vector<Pose> X_WT;
  for (const HandEyeSample& s : all) {
    const auto seen = s.views.empty() ? std::nullopt : SeeTag(cameras, tag_size, s);
    if (!seen) continue;
    samples.push_back(&s);
    X_WT.push_back(*seen);
  }
  const auto demand_enough = [](size_t n, const std::string& how) {
    if (n < kMinSamples) {
      Refuse(std::to_string(n) + " arm poses " + how + ", needed are " + std::to_string(kMinSamples) +
             ", better 20: take more");
    }
  };
  demand_enough(samples.size(), "show the tag");

  Eigen::Matrix3d scatter = Eigen::Matrix3d::Zero();
  for (size_t i = 0; i < samples.size(); ++i) {
    for (size_t k = 0; k < i; ++k) {
      const Eigen::Vector3d turn = LogSO3(samples[k]->X_BE.q.conjugate() * samples[i]->X_BE.q);
      out.turn = std::max(out.turn, turn.norm());
      scatter += turn * turn.transpose();
    }
  }
  if (out.turn < kMinTurn) {
    Refuse("the arm's orientations are too similar, " + Number(out.turn / kDegree, "%.0f") +
           " deg at most, needed are " + Number(kMinTurn / kDegree, "%.0f") + ": turn the wrist more");
  }
  const Eigen::Vector3d axes = Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d>(scatter).eigenvalues();
  out.spread = std::sqrt(std::max(0.0, axes[1]) / axes[2]);
  if (out.spread < kMinSpread) {
    Refuse(
        "the arm turns about one axis alone: what lies along it cannot be told; tilt the wrist to the sides "
        "too");
  }

  std::vector<cv::Mat> R_TW, t_TW, R_EB, t_EB;
  for (size_t i = 0; i < samples.size(); ++i) {
    const Pose X_TW = X_WT[i].Inverse(), X_EB = samples[i]->X_BE.Inverse();
    R_TW.push_back(Rotation(X_TW));
    t_TW.push_back(Translation(X_TW));
    R_EB.push_back(Rotation(X_EB));
    t_EB.push_back(Translation(X_EB));
  }
  cv::Mat R_WB, t_WB, R_TE, t_TE;
  cv::calibrateRobotWorldHandEye(R_TW, t_TW, R_EB, t_EB, R_WB, t_WB, R_TE, t_TE,
                                 cv::CALIB_ROBOT_WORLD_HAND_EYE_SHAH);
  HandEyeFit fit;
  fit.X_WB = ToPose(R_WB, t_WB);
  fit.X_ET = ToPose(R_TE, t_TE).Inverse();
  if (!fit.X_WB.IsFinite() || !fit.X_ET.IsFinite()) Refuse("the samples contradict each other");

  Refine(cameras, tag_size, samples, fit);
  // A wrong hypothesis of a tag, a blurred picture, an arm that had not come to rest.
  for (int round = 0; round < 3; ++round) {
    const double bar = std::max(kOutlier * Median(fit.sample_rms), 0.3);
    std::vector<const HandEyeSample*> kept;
    for (size_t i = 0; i < samples.size(); ++i) {
      if (fit.sample_rms[i] <= bar) {
        kept.push_back(samples[i]);
      } else {
        out.dropped.push_back(samples[i]->name);
      }
    }
    if (kept.size() == samples.size()) break;
    samples = kept;
    demand_enough(samples.size(), "fit together");
    Refine(cameras, tag_size, samples, fit);
  }
  out.X_WB = fit.X_WB;
  out.X_ET = fit.X_ET;
  out.samples = static_cast<int>(samples.size());
  out.rms_px = std::sqrt(fit.cost / fit.points);
  if (!(out.rms_px <= max_rms_px) || 2 * out.dropped.size() > static_cast<size_t>(out.samples)) {
    Refuse("arm and cameras do not agree: " + Number(out.rms_px) + " px (RMS) with " +
           std::to_string(out.dropped.size()) + " samples left out, allowed are " + Number(max_rms_px) +
           ": check the tag's size, the cameras' places, and that the tag sits firmly on the flange");
  }
  double sum = 0;
  for (const HandEyeSample* s : samples) {
    const auto seen = SeeTag(cameras, tag_size, *s);
    if (seen) sum += (seen->p - (fit.X_WB * s->X_BE * fit.X_ET).p).squaredNorm();
  }
  out.rms_m = std::sqrt(sum / out.samples);
  const Matrix12d covariance = fit.information.inverse() * (fit.cost / (2.0 * fit.points - 12));
  const auto largest = [](const Eigen::Matrix3d& m) {
    return std::sqrt(Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d>(m).eigenvalues().maxCoeff());
  };
  out.sigma_rad = largest(covariance.topLeftCorner<3, 3>());
  out.sigma_m = largest(covariance.block<3, 3>(3, 3));
  return out;
}

}  // namespace intabs
