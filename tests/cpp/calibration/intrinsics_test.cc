#include <catch2/catch.hpp>
#include <cstdio>
#include <filesystem>
#include <opencv2/aruco/charuco.hpp>
#include <opencv2/calib3d.hpp>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <random>

#include "intabs/perception/calibration.h"

namespace intabs {
namespace {

const cv::Size kSize(640, 480);
const cv::Matx33d kK(600, 0, 325, 0, 603, 236, 0, 0, 1);
const std::vector<double> kLens{-0.25, 0.08, 0.001, -0.0005, 0};
const Board kBoard{9, 6, 0.025, 0};

// n boards, tilted by up to tilt_deg, their centres within `reach` of the picture.
std::vector<BoardView> Views(int n, double tilt_deg, double reach, double noise_px, uint64_t seed) {
  std::mt19937_64 random(seed);
  std::uniform_real_distribution<double> unit(-1, 1);
  std::normal_distribution<double> noise(0, noise_px);
  std::vector<BoardView> views;
  while (static_cast<int>(views.size()) < n) {
    const double z = 0.35 + 0.1 * unit(random);
    const cv::Vec3d rvec = tilt_deg * CV_PI / 180 * cv::Vec3d(unit(random), unit(random), unit(random));
    const cv::Vec3d tvec(0.53 * z * reach * unit(random) - 0.1, 0.4 * z * reach * unit(random) - 0.0625, z);
    BoardView view;
    view.name = std::to_string(views.size());
    for (int y = 0; y < kBoard.rows; ++y) {
      for (int x = 0; x < kBoard.columns; ++x)
        view.points.emplace_back(static_cast<float>(x * kBoard.square), static_cast<float>(y * kBoard.square),
                                 0.f);
    }
    cv::projectPoints(view.points, rvec, tvec, kK, kLens, view.corners);
    bool inside = true;
    for (cv::Point2f& c : view.corners) {
      inside &= c.x > 4 && c.y > 4 && c.x < kSize.width - 5 && c.y < kSize.height - 5;
      c += cv::Point2f(static_cast<float>(noise(random)), static_cast<float>(noise(random)));
    }
    if (inside) views.push_back(view);
  }
  return views;
}

void Refused(const std::vector<BoardView>& views, const std::string& reason) {
  try {
    CalibrateIntrinsics(views, kSize);
    FAIL("was accepted, not refused as " << reason);
  } catch (const std::runtime_error& e) {
    CHECK_THAT(e.what(), Catch::Contains(reason));
    CHECK(std::string(e.what()).find('\n') == std::string::npos);
  }
}

}  // namespace

TEST_CASE("A lens is found again from noisy corners of a board") {
  for (const uint64_t seed : {1, 2, 3}) {
    const Intrinsics r = CalibrateIntrinsics(Views(30, 45, 1, 0.1, seed), kSize);
    CAPTURE(seed, r.model.fx, r.model.fy, r.model.cx, r.model.cy, r.rms_px);
    CHECK(std::abs(r.model.fx - kK(0, 0)) < 3);
    CHECK(std::abs(r.model.fy - kK(1, 1)) < 3);
    CHECK(std::abs(r.model.cx - kK(0, 2)) < 3);
    CHECK(std::abs(r.model.cy - kK(1, 2)) < 3);
    CHECK(r.rms_px < 0.2);
    CHECK(r.held_out_rms_px < 0.25);
    // What counts is where it says that points appear.
    CameraModel truth = r.model;
    truth.fx = kK(0, 0);
    truth.fy = kK(1, 1);
    truth.cx = kK(0, 2);
    truth.cy = kK(1, 2);
    std::copy(kLens.begin(), kLens.end(), truth.distortion.begin());
    for (const double x : {40., 320., 600.}) {
      for (const double y : {40., 240., 440.}) {
        const Eigen::Vector2d a = r.model.Undistort(Eigen::Vector2d(x, y)),
                              b = truth.Undistort(Eigen::Vector2d(x, y));
        const Eigen::Vector2d ray_a((a.x() - r.model.cx) / r.model.fx, (a.y() - r.model.cy) / r.model.fy);
        const Eigen::Vector2d ray_b((b.x() - truth.cx) / truth.fx, (b.y() - truth.cy) / truth.fy);
        CHECK((ray_a - ray_b).norm() < 0.008);
      }
    }
  }
}

TEST_CASE("A set of boards that cannot tell the lens is refused with the reason") {
  Refused(Views(7, 45, 1, 0.1, 1), "usable in 7 pictures");
  std::vector<BoardView> aside = Views(20, 45, 1, 0.1, 1);
  for (BoardView& v : aside) {
    for (cv::Point2f& c : v.corners) c *= 0.5f;
  }
  Refused(aside, "cover");
  Refused(Views(30, 4, 1, 0.1, 1), "tilted");
  Refused(Views(30, 45, 1, 1.0, 1), "off by");
}

TEST_CASE("A picture that does not fit the others is left out and named") {
  std::vector<BoardView> views = Views(30, 45, 1, 0.1, 5);
  std::mt19937 random(1);
  std::normal_distribution<float> noise(0, 4);
  for (cv::Point2f& c : views[11].corners) c += cv::Point2f(noise(random), noise(random));
  const Intrinsics r = CalibrateIntrinsics(views, kSize);
  CHECK(r.dropped == std::vector<std::string>{"11"});
  CHECK(r.views == 29);
  CHECK(r.rms_px < 0.2);
}

TEST_CASE("Chessboard and ChArUco board are found in pictures, at the right places") {
  const bool charuco = GENERATE(false, true);
  const Board board = charuco ? Board{7, 5, 0.03, 0.022} : Board{6, 4, 0.03, 0};
  cv::Mat drawn;
  constexpr int kSquarePx = 60, kMargin = 60;
  if (charuco) {
    const auto dictionary = cv::aruco::getPredefinedDictionary(cv::aruco::DICT_6X6_250);
    cv::aruco::CharucoBoard::create(7, 5, 0.03f, 0.022f, dictionary)
        ->draw({7 * kSquarePx + 2 * kMargin, 5 * kSquarePx + 2 * kMargin}, drawn, kMargin);
  } else {
    drawn = cv::Mat(5 * kSquarePx + 2 * kMargin, 7 * kSquarePx + 2 * kMargin, CV_8UC1, cv::Scalar(255));
    for (int y = 0; y < 5; ++y) {
      for (int x = y % 2; x < 7; x += 2)
        drawn(cv::Rect(kMargin + x * kSquarePx, kMargin + y * kSquarePx, kSquarePx, kSquarePx)) = 0;
    }
  }
  const cv::Matx33d H(0.8, 0.1, 30, -0.05, 0.7, 60, 1e-4, -2e-4, 1);
  cv::Mat picture;
  cv::warpPerspective(drawn, picture, H, kSize, cv::INTER_AREA, cv::BORDER_CONSTANT, cv::Scalar(120));
  cv::GaussianBlur(picture, picture, {0, 0}, 0.7);
  const auto view = FindBoard(picture, board);
  REQUIRE(view);
  CHECK(view->corners.size() == 24);
  // A homography of the drawing leads from the board's points to the corners: which one, the numbering
  // decides.
  std::vector<cv::Point2f> flat;
  for (const cv::Point3f& p : view->points) flat.emplace_back(p.x, p.y);
  const cv::Mat found = cv::findHomography(flat, view->corners);
  std::vector<cv::Point2f> projected;
  cv::perspectiveTransform(flat, projected, found);
  double worst = 0;
  for (size_t i = 0; i < flat.size(); ++i) worst = std::max(worst, cv::norm(projected[i] - view->corners[i]));
  CHECK(worst < 0.3);
  CHECK_FALSE(FindBoard(cv::Mat(kSize, CV_8UC1, cv::Scalar(90)), board));
}

TEST_CASE("Intrinsics from real photos: RMS at most half a pixel, and near what their own calibration says") {
  const std::string folder = std::string(INTABS_SOURCE_DIR) + "/../shared/data/apriltag/photos/calibration";
  if (!std::filesystem::exists(folder)) {
    WARN("skipped: no " << folder);
    return;
  }
  std::vector<BoardView> views;
  cv::Size size;
  int photos = 0;
  for (const auto& entry : std::filesystem::directory_iterator(folder)) {
    if (entry.path().extension() != ".JPG") continue;
    const cv::Mat gray = cv::imread(entry.path(), cv::IMREAD_GRAYSCALE);
    size = gray.size();
    ++photos;
    if (auto view = FindBoard(gray, {7, 5, 0.03, 0})) {
      view->name = entry.path().filename();
      views.push_back(*view);
    }
  }
  const Intrinsics r = CalibrateIntrinsics(views, size);
  std::printf(
      "%zu boards in %d photos, %d used: RMS %.3f px, held out %.3f px, coverage %.0f %%, fx %.2f fy %.2f cx "
      "%.2f cy %.2f\n",
      views.size(), photos, r.views, r.rms_px, r.held_out_rms_px, 100 * r.coverage, r.model.fx, r.model.fy,
      r.model.cx, r.model.cy);
  CHECK(r.views >= 15);
  CHECK(r.rms_px <= 0.5);
  CHECK(r.model.fx == Approx(765).epsilon(0.01));  // calib.txt
  CHECK(r.model.fy == Approx(764.18).epsilon(0.01));
  CHECK(r.model.cx == Approx(393.72).margin(8));
  CHECK(r.model.cy == Approx(304.66).margin(12));  // it and p1 make up for each other
}

}  // namespace intabs
