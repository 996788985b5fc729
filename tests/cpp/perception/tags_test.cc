#include <algorithm>
#include <catch2/catch.hpp>
#include <cmath>
#include <opencv2/core.hpp>

#include "intabs/perception/detector.h"
#include "intabs/perception/object_solver.h"
#include "intabs/perception/refine.h"
#include "intabs/perception/tag_pose.h"
#include "perception/synthetic.h"

using namespace intabs;
using test::LookAt;
using test::VgaCamera;
using test::View;

namespace {

double Uniform(cv::RNG& rng, double lo, double hi) { return rng.uniform(lo, hi); }

// A tag at `distance` before the camera, its normal `tilt` off the line of sight, in a random direction and
// spin.
Pose Facing(cv::RNG& rng, double distance, double tilt) {
  const Eigen::Vector3d ray(Uniform(rng, -.25, .25), Uniform(rng, -.2, .2), 1);
  const double azimuth = Uniform(rng, 0, 2 * M_PI);
  const Eigen::Quaterniond q = ExpSO3(tilt * Eigen::Vector3d(std::cos(azimuth), std::sin(azimuth), 0)) *
                               ExpSO3(Eigen::Vector3d(0, 0, Uniform(rng, 0, 2 * M_PI)));
  return {distance * ray, q};
}

TagCorners Projected(const CameraModel& camera, const Pose& X_CT, double size) {
  TagCorners corners;
  for (int k = 0; k < 4; ++k) corners[k] = camera.Project(X_CT * TagPoints(size)[k]);
  return corners;
}

}  // namespace

TEST_CASE("Corners come in OpenCV's pixel-centre convention, without AprilTag's half pixel") {
  const CameraModel camera = VgaCamera("c", Pose{});
  cv::RNG rng(3);
  Eigen::Vector2d sum = Eigen::Vector2d::Zero();
  double square = 0;
  int n = 0;
  for (int i = 0; i < 25; ++i) {
    const Pose X_CT = Facing(rng, 0.5, 0.3);
    TagDetector detector({7});
    const auto& tags = detector.Detect(View(camera, {{7, {X_CT, 0.05}}}, i), {}, true);
    REQUIRE(tags.size() == 1);
    const TagCorners truth = Projected(camera, X_CT, 0.05);
    for (int k = 0; k < 4; ++k) {
      sum += tags[0].corners[k] - truth[k];
      square += (tags[0].corners[k] - truth[k]).squaredNorm();
      ++n;
    }
  }
  INFO("mean error " << sum.transpose() / n << " px, rms " << std::sqrt(square / n) << " px");
  CHECK(std::abs(sum.x() / n) < 0.04);
  CHECK(std::abs(sum.y() / n) < 0.04);
  CHECK(std::sqrt(square / n) < 0.06);
}

TEST_CASE("A region at full resolution gives the corners of the whole frame") {
  const CameraModel camera = VgaCamera("c", Pose{});
  cv::RNG rng(5);
  TagDetector follows({7});
  for (int i = 0; i < 20; ++i) {
    const Pose X_CT = Facing(rng, 0.7, 0.4);
    const cv::Mat image = View(camera, {{7, {X_CT, 0.05}}}, i);
    TagDetector whole({7});
    const auto expected = whole.Detect(image, {}, true);
    const auto got =
        follows.Detect(image, {}, false);  // the tag jumps: lost and found by the scan, measured in a region
    REQUIRE(expected.size() == 1);
    REQUIRE(got.size() == 1);
    for (int k = 0; k < 4; ++k) CHECK((got[0].corners[k] - expected[0].corners[k]).norm() < 0.1);
  }
}

TEST_CASE("Noise-free corners give the pose back, whatever the view") {
  const CameraModel camera = VgaCamera("c", Pose{});
  cv::RNG rng(7);
  for (int i = 0; i < 500; ++i) {
    const double tilt = Uniform(rng, 0, 1.2), distance = Uniform(rng, 0.2, 1.6);
    const Pose X_CT = Facing(rng, distance, tilt);
    const TagPose pose = SolveTag(camera, 0.04, Projected(camera, X_CT, 0.04));
    INFO("view " << i << ": distance " << distance << " m, tilt " << tilt << " rad");
    REQUIRE(pose.ok);
    CHECK(pose.reprojection_px[0] < 1e-4);
    CHECK((pose.X_CT[0].p - X_CT.p).norm() < 1e-5);
    CHECK(AngleBetween(pose.X_CT[0].q, X_CT.q) < 1e-3);
  }
}

TEST_CASE("Both hypotheses of a small oblique tag are given, and one of them is right") {
  const CameraModel camera = VgaCamera("c", Pose{});
  cv::RNG rng(11);
  int second_was_right = 0;
  const int n = 200;
  for (int i = 0; i < n; ++i) {
    const Pose X_CT = Facing(rng, 1.3, 0.35);
    TagCorners corners = Projected(camera, X_CT, 0.05);
    for (Eigen::Vector2d& c : corners) c += Eigen::Vector2d(rng.gaussian(.2), rng.gaussian(.2));
    const TagPose pose = SolveTag(camera, 0.05, corners);
    REQUIRE(pose.ok);
    CHECK(pose.reprojection_px[0] <= pose.reprojection_px[1]);
    CHECK(pose.ambiguity == Approx(pose.reprojection_px[0] / pose.reprojection_px[1]));
    const double e0 = AngleBetween(pose.X_CT[0].q, X_CT.q), e1 = AngleBetween(pose.X_CT[1].q, X_CT.q);
    CHECK(std::min(e0, e1) < 0.35);
    second_was_right += e1 < e0;
  }
  // Else the views were too easy to show that the second hypothesis is worth keeping.
  INFO(second_was_right << " of " << n);
  CHECK(second_was_right >= n / 20);
  CHECK(second_was_right <= n / 2);
}

TEST_CASE("Refined corners of small oblique tags lie within hundredths of a pixel") {
  const CameraModel camera = VgaCamera("c", Pose{});
  cv::RNG rng(29);
  double square = 0;
  int n = 0;
  for (int i = 0; i < 30; ++i) {
    const Pose X_CT = Facing(rng, 0.8, Uniform(rng, 0, 1.0));
    const cv::Mat image = View(camera, {{7, {X_CT, 0.032}}}, i, {.blur_px = .6, .noise = 2});
    const TagCorners truth = Projected(camera, X_CT, 0.032);
    TagCorners corners = truth;
    for (Eigen::Vector2d& c : corners) c += Eigen::Vector2d(Uniform(rng, -1, 1), Uniform(rng, -1, 1));
    INFO("view " << i);
    REQUIRE(RefineCorners(image, test::Pattern(7), corners));
    for (int k = 0; k < 4; ++k) {
      square += (corners[k] - truth[k]).squaredNorm();
      ++n;
    }
  }
  INFO("rms " << std::sqrt(square / n) << " px");
  CHECK(std::sqrt(square / n) < 0.08);
}

TEST_CASE("Refined corners say how far they are off, near and far, face on and oblique") {
  const CameraModel camera = VgaCamera("c", Pose{});
  for (const double distance : {0.35, 0.6, 1.0, 1.4}) {
    cv::RNG rng(37);
    int inside = 0, n = 0;
    for (int i = 0; i < 60; ++i) {
      const Pose X_CT = Facing(rng, distance, Uniform(rng, 0, 1.0));
      const TagCorners truth = Projected(camera, X_CT, 0.05);
      TagCorners corners = truth;
      for (Eigen::Vector2d& c : corners) c += Eigen::Vector2d(Uniform(rng, -.7, .7), Uniform(rng, -.7, .7));
      Matrix8d covariance;
      if (!RefineCorners(View(camera, {{7, {X_CT, 0.05}}}, i), test::Pattern(7), corners, &covariance))
        continue;
      Eigen::Matrix<double, 8, 1> e;
      for (int k = 0; k < 4; ++k) e.segment<2>(2 * k) = corners[k] - truth[k];
      inside += (Whitening(covariance) * e).squaredNorm() < 15.507;  // chi-square, 8 degrees of freedom, 95 %
      ++n;
    }
    INFO(distance << " m: " << inside << " of " << n << " inside the 95 % ellipsoid");
    CHECK(n >= 55);
    CHECK(inside >= .85 * n);
  }
}

TEST_CASE("Small tags turn up within a round of scans, though halved they are too small") {
  const CameraModel camera = VgaCamera("c", Pose{});
  cv::RNG rng(41);
  int n = 0, later = 0;
  for (int i = 0; i < 12; ++i) {
    const double x = Uniform(rng, -.4, .4), y = Uniform(rng, -.6, .6);
    const Pose X_CT{{x, y, 2.2}, ExpSO3({Uniform(rng, -.2, .2), Uniform(rng, -.2, .2), Uniform(rng, 0, 6)})};
    const cv::Mat image = View(camera, {{7, {X_CT, 0.05}}}, i);
    TagDetector whole({7}), scanning({7}, {.budget_px = 200000});
    if (whole.Detect(image, {}, true).empty()) continue;
    scanning.Detect(View(camera, {}, 100), {}, true);
    int scans = 1;
    while (scanning.Detect(image, {}, true).empty() && scans <= 4) ++scans;
    INFO("view " << i);
    CHECK(scans <= 4);
    ++n;
    later += scans > 1;
  }
  CHECK(n >= 8);
  CHECK(later >= 2);  // else the halved picture showed them all
}

TEST_CASE("A frame's budget is kept, and every tag gets its turn") {
  const CameraModel camera = VgaCamera("c", Pose{});
  test::Scene scene;
  for (int i = 0; i < 4; ++i) scene[7 + i] = {{{-.25 + .17 * i, .1 * (i % 2), .8}, ExpSO3({.3, .2, 0})}, .05};
  TagDetector detector({}, {.budget_px = 12000});  // a region is about 9000
  REQUIRE(detector.Detect(View(camera, scene, 1), {}, true).size() == 4);
  std::vector<cv::Rect> expected;
  for (const auto& [id, tag] : scene) {
    const auto corners = Projected(camera, tag.X_WT, tag.size);
    expected.emplace_back(cv::Point(corners[3].x() - 30, corners[3].y() - 30), cv::Size(95, 95));
  }
  std::vector<int> seen(20, 0);
  for (int frame = 0; frame < 8; ++frame) {
    const auto& tags = detector.Detect(View(camera, scene, 2 + frame), expected, true);
    CHECK(tags.size() == 1);
    for (const SeenTag& t : tags) ++seen.at(t.id);
  }
  for (const auto& [id, tag] : scene) CHECK(seen[id] == 2);
}

TEST_CASE("Several threads find what one finds") {
  const CameraModel camera = VgaCamera("c", Pose{});
  cv::RNG rng(43);
  for (int i = 0; i < 5; ++i) {
    const cv::Mat image = View(camera, {{7, {Facing(rng, .6, .5), 0.05}}}, i);
    TagDetector one({}), two({}, {.threads = 2});
    const auto a = one.Detect(image, {}, true), b = two.Detect(image, {}, true);
    REQUIRE(a.size() == 1);
    REQUIRE(b.size() == 1);
    for (int k = 0; k < 4; ++k) CHECK((a[0].corners[k] - b[0].corners[k]).norm() < .01);
  }
}

TEST_CASE("Corners are left alone where the picture is not that tag") {
  const CameraModel camera = VgaCamera("c", Pose{});
  const Pose X_CT{{0, 0, .6}, ExpSO3({.4, .2, .3})};
  const TagCorners truth = Projected(camera, X_CT, 0.04);
  const auto refuses = [&](const cv::Mat& image, int id) {
    TagCorners corners = truth;
    const bool refined = RefineCorners(image, test::Pattern(id), corners);
    for (int k = 0; k < 4; ++k) CHECK((corners[k] == truth[k]) == !refined);
    return !refined;
  };
  const cv::Mat image = View(camera, {{7, {X_CT, 0.04}}}, 1);
  CHECK_FALSE(refuses(image, 7));
  CHECK(refuses(image, 8));
  CHECK(refuses(cv::Mat(480, 640, CV_8UC1, cv::Scalar(0)), 7));
  CHECK(refuses(View(camera, {}, 2), 7));
}

TEST_CASE("Degenerate corners give no pose, never one that is not finite") {
  const CameraModel camera = VgaCamera("c", Pose{});
  const Eigen::Vector2d a(300, 200);
  std::vector<TagCorners> cases{
      {a, a, a, a},                                                                             // a point
      {a, a + Eigen::Vector2d(10, 0), a + Eigen::Vector2d(20, 0), a + Eigen::Vector2d(30, 0)},  // a line
      {a, a + Eigen::Vector2d(10, 0), a, a + Eigen::Vector2d(10, 0)},
      {a, a + Eigen::Vector2d(10, 0), a + Eigen::Vector2d(10, -10), Eigen::Vector2d(NAN, 0)},
      {a, a + Eigen::Vector2d(1e-9, 0), a + Eigen::Vector2d(1e-9, -1e-9), a + Eigen::Vector2d(0, -1e-9)}};
  cv::RNG rng(13);
  for (int i = 0; i < 300; ++i) {  // and seen edge on
    cases.push_back(
        Projected(camera, Facing(rng, Uniform(rng, .2, 1.5), M_PI / 2 + Uniform(rng, -.01, .01)), .04));
  }
  for (const TagCorners& corners : cases) {
    const TagPose pose = SolveTag(camera, 0.04, corners);
    if (!pose.ok) continue;
    CHECK(pose.X_CT[0].IsFinite());
    CHECK(pose.X_CT[1].IsFinite());
    CHECK(std::isfinite(pose.ambiguity));
  }
}

TEST_CASE("The solver's Jacobian is the derivative of the reprojection") {
  // Two cameras, four points: the minimum's information against numerical second differences of the cost.
  const CameraModel left = VgaCamera("l", LookAt({.8, .3, .5}, {.3, 0, 0}));
  const CameraModel right = VgaCamera("r", LookAt({.8, -.3, .5}, {.3, 0, 0}));
  const std::vector<PlacedCamera> cameras{{&left, *left.X_WC}, {&right, *right.X_WC}};
  const Pose X_WO{{.3, .02, .01}, ExpSO3({.3, -.2, .5})};
  std::vector<PointView> points;
  for (int c = 0; c < 2; ++c) {
    for (const Eigen::Vector3d& p : TagPoints(0.05)) {
      points.push_back({p, cameras[c].model->Project(cameras[c].X_WC.Inverse() * (X_WO * p)), c});
    }
  }
  const Pose start{X_WO.p + Eigen::Vector3d(.02, -.01, .02), X_WO.q * ExpSO3({.1, .1, .1})};
  const PoseFit fit = FitPose(cameras, points, start);
  REQUIRE(fit.ok);
  CHECK((fit.X_WO.p - X_WO.p).norm() < 1e-8);
  CHECK(AngleBetween(fit.X_WO.q, X_WO.q) < 1e-7);
  const double h = 1e-5;
  const auto cost = [&](const Vector6d& d) {
    const Pose moved{X_WO.p + d.tail<3>(), ExpSO3(d.head<3>()) * X_WO.q};
    return points.size() * std::pow(ReprojectionRms(cameras, points, moved), 2);
  };
  for (int i = 0; i < 6; ++i) {
    for (int j = 0; j < 6; ++j) {
      const Vector6d a = h * Vector6d::Unit(i), b = h * Vector6d::Unit(j);
      const double second = (cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / (4 * h * h) / 2;
      CHECK(fit.information(i, j) == Approx(second).epsilon(1e-3).margin(1e-3 * fit.information.norm()));
    }
  }
}

TEST_CASE("Where a camera is known to stand only roughly, the pose says so and stays right") {
  // The right camera stands 2 mm and 0.3 deg off its place, in any direction.
  const CameraModel left = VgaCamera("l", LookAt({.8, .4, .5}, {.3, 0, 0}));
  const CameraModel right = VgaCamera("r", LookAt({.8, -.4, .5}, {.3, 0, 0}));
  const double sigma_p = .002, sigma_r = .3 * M_PI / 180, sigma_px = .05;
  Vector6d sigma;
  sigma << Eigen::Vector3d::Constant(sigma_r), Eigen::Vector3d::Constant(sigma_p);
  std::vector<PlacedCamera> placed{{&left, *left.X_WC}, {&right, *right.X_WC}};
  std::vector<PlacedCamera> uncertain = placed;
  uncertain[1].information = sigma.array().square().inverse().matrix().asDiagonal();
  cv::RNG rng(47);
  const auto draw = [&](double s) {
    return Eigen::Vector3d(rng.gaussian(s), rng.gaussian(s), rng.gaussian(s));
  };
  int inside = 0, inside_without = 0;
  const int n = 300;
  std::vector<double> mm;
  for (int i = 0; i < n; ++i) {
    const Pose X_WO{Eigen::Vector3d(.3, 0, .02) + draw(.03),
                    ExpSO3(draw(.3)) * Eigen::Quaterniond(0, 1, 0, 0)};
    const std::array<Pose, 2> stands{*left.X_WC,
                                     {right.X_WC->p + sigma_p * draw(1).normalized(),
                                      right.X_WC->q * ExpSO3(sigma_r * draw(1).normalized())}};
    std::vector<TagView> views;
    for (int c = 0; c < 2; ++c) {
      TagView view{c, .04, Pose{}, {}, {}, sigma_px * sigma_px * Matrix8d::Identity()};
      for (int k = 0; k < 4; ++k) {
        view.corners[k] = placed[c].model->Project(stands[c].Inverse() * (X_WO * TagPoints(.04)[k])) +
                          Eigen::Vector2d(rng.gaussian(sigma_px), rng.gaussian(sigma_px));
      }
      view.hypotheses = SolveTag(*placed[c].model, .04, view.corners);
      views.push_back(view);
    }
    const auto chi2 = [&](const ObjectPose& got) {
      Vector6d e;
      e << LogSO3(X_WO.q * got.X_WO.q.conjugate()), X_WO.p - got.X_WO.p;
      return e.dot(got.covariance.ldlt().solve(e));
    };
    const ObjectFit fit = SolveObject(uncertain, views, {});
    REQUIRE(fit.valid);
    CHECK(AngleBetween(fit.minima[0].X_WO.q, X_WO.q) < 10 * M_PI / 180);
    mm.push_back(1e3 * (fit.minima[0].X_WO.p - X_WO.p).norm());
    inside += chi2(fit.minima[0]) < 12.592;
    const ObjectFit sure = SolveObject(placed, views, {});
    inside_without += sure.valid && chi2(sure.minima[0]) < 12.592;
  }
  std::sort(mm.begin(), mm.end());
  INFO(inside << " of " << n << " inside the 95 % ellipsoid (" << inside_without << " when sure), p95 "
              << mm[n * 95 / 100] << " mm");
  CHECK(inside >= .9 * n);
  CHECK(inside_without < .5 * n);
  CHECK(mm[n * 95 / 100] < 2.5);
}
