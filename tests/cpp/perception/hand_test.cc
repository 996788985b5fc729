#include "intabs/perception/hand_tracker.h"

#include <algorithm>
#include <catch2/catch.hpp>
#include <cmath>
#include <limits>
#include <opencv2/imgproc.hpp>
#include <random>

namespace intabs {
namespace {

constexpr double kPeriod = 1.0 / 30;
constexpr double kNone = std::numeric_limits<double>::quiet_NaN();

CameraModel Camera() {
  CameraModel c;
  c.width = 640;
  c.height = 480;
  c.fx = c.fy = 610;
  c.cx = 319.5;
  c.cy = 239.5;
  return c;
}

using Points = std::array<Eigen::Vector3d, kHandPoints>;

// An open hand with the bones of the table, palm to the camera, wrist at `wrist` (C), fingers up the picture.
Points OpenHand(const Eigen::Vector3d& wrist) {
  Points p;
  p[0] = wrist;
  const double spread[] = {-0.75, -0.30, -0.07, 0.12, 0.33};  // [rad]
  for (const Bone& bone : HandBones()) {
    if (bone.a == 5 && bone.b == 17) continue;
    const double a = spread[(bone.b - 1) / 4];
    p[bone.b] = p[bone.a] + bone.length * Eigen::Vector3d(std::sin(a), -std::cos(a), 0);
  }
  return p;
}

HandPixels Pixels(const Points& p, double noise = 0, std::mt19937* rng = nullptr) {
  std::normal_distribution<double> normal;
  HandPixels uv;
  for (int i = 0; i < kHandPoints; ++i) {
    uv[i] = Camera().Project(p[i]);
    if (rng) uv[i] += noise * Eigen::Vector2d(normal(*rng), normal(*rng));
  }
  return uv;
}

// Depth in mm: bones 16 mm thick, a palm, and a wall half a metre behind (0: none).
cv::Mat Depth(const Points& p, double wall = 0.5) {
  const CameraModel camera = Camera();
  const double z = p[0].z();
  cv::Mat depth(camera.height, camera.width, CV_16UC1, cv::Scalar(wall > 0 ? 1000 * (z + wall) : 0));
  const cv::Scalar mm(1000 * (z - 0.008));
  std::vector<cv::Point> palm;
  const auto pixel = [&](int i) {
    const Eigen::Vector2d uv = camera.Project(p[i]);
    return cv::Point(cvRound(uv.x()), cvRound(uv.y()));
  };
  for (const int i : {0, 1, 5, 9, 13, 17}) palm.push_back(pixel(i));
  cv::fillConvexPoly(depth, palm, mm);
  for (const Bone& bone : HandBones()) {
    cv::line(depth, pixel(bone.a), pixel(bone.b), mm, cvRound(0.016 / z * camera.fx));
  }
  return depth;
}

double ShareWrong(DepthMethod method, double noise_px, double wall) {
  int wrong = 0, all = 0;
  std::mt19937 rng(1);
  const Points truth = OpenHand({0, 0.1, 0.8});
  const cv::Mat depth = Depth(truth, wall);
  for (int k = 0; k < 50; ++k) {
    const HandPoints hand =
        LiftHand(Camera(), Pixels(truth, noise_px, &rng), depth, 0.001, {.method = method});
    for (int i = 0; i < kHandPoints; ++i, ++all) {
      wrong += hand.state[i] != PointState::kMeasured || std::abs(hand.p[i].z() - truth[i].z()) > 0.02;
    }
  }
  return static_cast<double>(wrong) / all;
}

// A hand that goes 30 cm to the side and back in 2 s, seen exactly.
std::vector<HandFrame> Sweep(int n = 60) {
  std::vector<HandFrame> frames(n);
  for (int k = 0; k < n; ++k) {
    HandFrame& f = frames[k];
    f.time = k * kPeriod;
    const Points p = OpenHand({0.15 * std::cos(M_PI * f.time), 0.1, 0.8});
    f.pixels = Pixels(p);
    f.hand_C.p = p;
    f.hand_C.state.fill(PointState::kMeasured);
  }
  return frames;
}

void Unsee(HandFrame& f) {
  f.pixels.fill(Eigen::Vector2d(kNone, kNone));
  f.hand_C = {};
}

void Replace(HandFrame& f, const Points& p) {
  f.pixels = Pixels(p);
  f.hand_C.p = p;
  f.hand_C.state.fill(PointState::kMeasured);
}

int Count(const HandPoints& hand, PointState state) {
  return static_cast<int>(std::count(hand.state.begin(), hand.state.end(), state));
}

}  // namespace

TEST_CASE("With a wall behind the hand the median near the palm holds where the thesis' mean does not") {
  CHECK(ShareWrong(DepthMethod::kRobust, 4, 0.5) < 0.02);
  CHECK(ShareWrong(DepthMethod::kGaussian, 4, 0.5) > 0.4);
  // Without anything behind it both do.
  CHECK(ShareWrong(DepthMethod::kRobust, 0, 0) == 0);
  CHECK(ShareWrong(DepthMethod::kGaussian, 0, 0) == 0);
}

TEST_CASE("A key point comes out where the joint is, also through a lens") {
  CameraModel camera = Camera();
  camera.distortion = {-0.2, 0.05, 0.001, 0.001, 0};
  const Points truth = OpenHand({0.1, 0.1, 0.8});
  HandPixels uv = Pixels(truth);
  for (Eigen::Vector2d& x : uv) x = camera.Distort(x);
  HandDepths z;
  for (int i = 0; i < kHandPoints; ++i) z[i] = truth[i].z() - 0.008;
  const HandPoints hand = LiftHand(camera, uv, z);
  for (int i = 0; i < kHandPoints; ++i) {
    CAPTURE(i);
    REQUIRE(hand.state[i] == PointState::kMeasured);
    REQUIRE((hand.p[i] - truth[i]).norm() < 1e-6);
  }
}

TEST_CASE("Depth far from the palm's, none at all, and key points not seen are told apart") {
  const Points truth = OpenHand({0, 0.1, 0.8});
  HandPixels uv = Pixels(truth);
  uv[4] = {kNone, kNone};
  uv[8] = {1e12, -5};
  uv[9] = {-1e300, 1e300};
  uv[12] = {5, 5};  // on the wall
  const HandPoints hand = LiftHand(Camera(), uv, Depth(truth), 0.001);
  REQUIRE(hand.state[4] == PointState::kUnseen);
  REQUIRE(hand.state[8] == PointState::kUnseen);
  REQUIRE(hand.state[9] == PointState::kUnseen);
  REQUIRE(hand.state[12] == PointState::kNoDepth);
  REQUIRE(Count(hand, PointState::kMeasured) == 17);

  HandDepths z;
  z.fill(0.8);
  z[8] = 1.3;
  z[12] = 0;
  z[16] = kNone;
  const HandPoints sampled = LiftHand(Camera(), Pixels(truth), z);
  for (const int i : {8, 12, 16}) REQUIRE(sampled.state[i] == PointState::kNoDepth);
  REQUIRE(Count(sampled, PointState::kMeasured) == 18);
  REQUIRE(LiftHand(Camera(), Pixels(truth), z, {.method = DepthMethod::kGaussian}).state[8] ==
          PointState::kMeasured);

  REQUIRE(Count(LiftHand(Camera(), Pixels(truth), cv::Mat::zeros(480, 640, CV_16UC1), 0.001),
                PointState::kNoDepth) == kHandPoints);
}

TEST_CASE("A depth picture of another kind is refused by name") {
  const HandPixels uv = Pixels(OpenHand({0, 0.1, 0.8}));
  REQUIRE_THROWS_WITH(LiftHand(Camera(), uv, cv::Mat::zeros(240, 320, CV_16UC1), 0.001),
                      Catch::Contains("640 x 480"));
  REQUIRE_THROWS_WITH(LiftHand(Camera(), uv, cv::Mat::zeros(480, 640, CV_32FC1), 0.001),
                      Catch::Contains("uint16"));
  REQUIRE_THROWS_WITH(LiftHand(Camera(), uv, cv::Mat::zeros(480, 640, CV_16UC1), 0.0),
                      Catch::Contains("unit"));
  std::vector<HandFrame> frames = Sweep(3);
  frames[2].time = frames[1].time;
  REQUIRE_THROWS_WITH(FilterHand(frames), Catch::Contains("frame 2"));
}

TEST_CASE("Of a bone too long it is the wrong end that goes") {
  for (int i = 0; i < kHandPoints; ++i) {
    HandPoints hand;
    hand.p = OpenHand({0, 0.1, 0.8});
    hand.state.fill(PointState::kMeasured);
    HandPoints good = hand;
    DropLongBones(good, 0.3, 0.02);
    REQUIRE(Count(good, PointState::kMeasured) == kHandPoints);
    // Away from the hand's own plane: no other bone gets better by it.
    hand.p[i].z() += 0.12;
    DropLongBones(hand, 0.3, 0.02);
    CAPTURE(i);
    const bool tip = i > 0 && i % 4 == 0, inner = i % 4 == 3 || i % 4 == 2;
    if (!tip && !inner) {
      REQUIRE(hand.state[i] == PointState::kBone);
      REQUIRE(Count(hand, PointState::kBone) == 1);
    } else {  // the end of a chain and its neighbour accuse each other
      REQUIRE(Count(hand, PointState::kBone) >= 1);
      REQUIRE(Count(hand, PointState::kBone) <= 2);
    }
  }
}

TEST_CASE("Hands of twice or half the size are no hands; those of big and small people are") {
  for (const auto& [scale, kept] : {std::pair{0.42, false}, {0.8, true}, {1.25, true}, {2.5, false}}) {
    HandPoints hand;
    hand.p = OpenHand({0, 0, 0});
    for (Eigen::Vector3d& p : hand.p) p *= scale;
    hand.state.fill(PointState::kMeasured);
    DropLongBones(hand, 0.3, 0.02);
    CAPTURE(scale);
    REQUIRE(Count(hand, PointState::kMeasured) == (kept ? kHandPoints : 0));
  }
}

TEST_CASE("Detections at a fixed place go, the hand that rests does not") {
  std::vector<HandFrame> frames = Sweep(90);
  for (int k = 60; k < 90; ++k) Replace(frames[k], frames[60].hand_C.p);  // at rest where it came to
  const Points stain = OpenHand({-0.25, -0.1, 0.95});
  for (const int k : {0, 1, 20, 21, 22, 45, 70, 71}) Replace(frames[k], stain);
  std::vector<HandPoints> hands;
  for (const HandFrame& f : frames) hands.push_back(f.hand_C);
  DropFixedPlaces(frames, hands, 3);
  for (int k = 0; k < 90; ++k) {
    CAPTURE(k);
    const bool false_one = k < 2 || (k >= 20 && k < 23) || k == 45 || k == 70 || k == 71;
    REQUIRE(Count(hands[k], false_one ? PointState::kFixedPlace : PointState::kMeasured) == kHandPoints);
  }
}

TEST_CASE("A hand that never moves is kept") {
  std::vector<HandFrame> frames = Sweep(30);
  for (HandFrame& f : frames) Replace(f, frames[0].hand_C.p);
  for (const HandPoints& hand : FilterHand(frames))
    REQUIRE(Count(hand, PointState::kMeasured) == kHandPoints);
}

TEST_CASE("Jumps go, even when they come first, and the hand is found again") {
  std::vector<HandFrame> frames = Sweep();
  Points elsewhere = OpenHand({0.1, 0.1, 1.6});
  std::vector<double> time;
  std::vector<HandPoints> hands;
  for (int k = 0; k < 60; ++k) {
    if (k < 3 || (k >= 30 && k < 34)) {
      for (Eigen::Vector3d& p : elsewhere) p.x() += 0.002;
      Replace(frames[k], elsewhere);
    }
    if (k == 50) frames[k].hand_C.p[8] += Eigen::Vector3d(0, 0, 0.12);
    time.push_back(frames[k].time);
    hands.push_back(frames[k].hand_C);
  }
  DropJumps(time, hands, {});
  for (int k = 0; k < 60; ++k) {
    CAPTURE(k);
    const bool wrong = k < 3 || (k >= 30 && k < 34);
    REQUIRE(Count(hands[k], PointState::kJump) == (wrong ? kHandPoints : k == 50 ? 1 : 0));
  }
  REQUIRE(hands[50].state[8] == PointState::kJump);
}

TEST_CASE("Short gaps are filled in W, long ones stay open, also with a camera that moves") {
  std::vector<HandFrame> frames = Sweep(90);
  std::vector<Points> truth;
  for (int k = 0; k < 90; ++k) {
    frames[k].X_WC = {{0.5, 0.3 * frames[k].time, 0.7}, ExpSO3({2 + 0.2 * frames[k].time, 0.1, 0})};
    truth.push_back(frames[k].hand_C.p);
    for (Eigen::Vector3d& p : truth.back()) p = frames[k].X_WC * p;
    if ((k >= 20 && k < 26) || (k >= 50 && k < 70)) Unsee(frames[k]);
  }
  const std::vector<HandPoints> hands = FilterHand(frames);
  for (int k = 0; k < 90; ++k) {
    CAPTURE(k);
    if (k >= 50 && k < 70) {
      REQUIRE(Count(hands[k], PointState::kUnseen) == kHandPoints);
      REQUIRE(hands[k].p[3] == Eigen::Vector3d::Zero());
      continue;
    }
    const bool gap = k >= 20 && k < 26;
    REQUIRE(Count(hands[k], gap ? PointState::kFilled : PointState::kMeasured) == kHandPoints);
    for (int i = 0; i < kHandPoints; ++i)
      REQUIRE((hands[k].p[i] - truth[k][i]).norm() < (gap ? 0.005 : 1e-9));
  }
}

TEST_CASE(
    "As frames come, what no hand does goes in the very frame, and what is missing is foretold for a while") {
  std::vector<HandFrame> frames = Sweep(90);
  std::vector<Points> truth;
  const Points elsewhere = OpenHand({0.1, 0.1, 1.6});
  for (int k = 0; k < 90; ++k) {
    frames[k].X_WC = {{0.5, 0.3, 0.7}, ExpSO3({2, 0.1, 0})};
    truth.push_back(frames[k].hand_C.p);
    for (Eigen::Vector3d& p : truth.back()) p = frames[k].X_WC * p;
    if (k >= 20 && k < 23) Replace(frames[k], elsewhere);
    if (k == 35) frames[k].hand_C.p[8] += Eigen::Vector3d(0, 0, 0.12);
    if (k >= 45 && k < 70) Unsee(frames[k]);
  }
  HandTracker tracker;
  double sigma = 0;
  for (int k = 0; k < 90; ++k) {
    CAPTURE(k);
    const HandEstimate hand = tracker.Update(frames[k]);
    const bool gap = (k >= 20 && k < 23) || (k >= 45 && k < 60);  // 15 frames: half a second
    const bool lost = k >= 60 && k < 70;
    const int filled = Count(hand.hand_W, PointState::kFilled);
    if (k == 35) {  // the fingertip goes, and perhaps a neighbour with it
      REQUIRE(hand.hand_W.state[8] == PointState::kFilled);
      REQUIRE(filled <= 2);
    } else {
      REQUIRE(filled == (gap ? kHandPoints : 0));
    }
    REQUIRE(Count(hand.hand_W, PointState::kUnseen) == (lost ? kHandPoints : 0));
    for (int i = 0; i < kHandPoints; ++i) {
      const double error = (hand.hand_W.p[i] - truth[k][i]).norm();
      if (lost) {
        REQUIRE(hand.hand_W.p[i] == Eigen::Vector3d::Zero());
        REQUIRE(hand.sigma[i] == 0);
      } else if (hand.hand_W.state[i] == PointState::kFilled) {
        REQUIRE(hand.sigma[i] > 0.005);
        REQUIRE(error < 4 * std::sqrt(3) * hand.sigma[i]);
        if (k < 45) REQUIRE(error < 0.03);
      } else {
        REQUIRE(error < 1e-9);
        REQUIRE(hand.sigma[i] == 0.005);
      }
    }
    if (gap && k > 45) REQUIRE(hand.sigma[0] > sigma);
    sigma = hand.sigma[0];
  }
  // Time that goes back starts anew: nothing is foretold from before.
  Unsee(frames[0]);
  REQUIRE(Count(tracker.Update(frames[0]).hand_W, PointState::kUnseen) == kHandPoints);
}

}  // namespace intabs
