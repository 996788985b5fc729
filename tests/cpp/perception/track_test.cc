#include <catch2/catch.hpp>
#include <cmath>
#include <opencv2/core.hpp>

#include "intabs/perception/pose_track.h"
#include "perception/synthetic.h"

using namespace intabs;
using test::VgaCamera;

namespace {

constexpr double kDt = 1 / 30.;
constexpr double kGross = 10 * M_PI / 180;

// A tag that wanders about 1.3 m before the camera, facing it more or less: what makes its pose ambiguous.
Pose Wandering(double t, double phase) {
  const auto s = [&](double w) { return std::sin(w * t + w * phase); };
  return {{.2 * s(.7), .15 * s(.9), 1.3 + .1 * s(.5)}, ExpSO3({.45 * s(1.3), .45 * s(.8), s(.4)})};
}

// What a frame with corner noise of sigma px says of it.
std::vector<ObjectPose> Seen(const CameraModel& camera, const Pose& X_CT, cv::RNG& rng, double sigma) {
  TagView view{0, .05, Pose{}, {}, {}, sigma * sigma * Matrix8d::Identity()};
  for (int k = 0; k < 4; ++k) {
    view.corners[k] =
        camera.Project(X_CT * TagPoints(.05)[k]) + Eigen::Vector2d(rng.gaussian(sigma), rng.gaussian(sigma));
  }
  view.hypotheses = SolveTag(camera, .05, view.corners);
  const PlacedCamera placed{&camera, Pose{}};
  return SolveObject({&placed, 1}, {view}, {}).minima;
}

bool Gross(const Pose& a, const Pose& truth) { return AngleBetween(a.q, truth.q) > kGross; }

// A pose that is certain, for tests of what the track makes of it.
std::vector<ObjectPose> Certain(const Pose& X) {
  ObjectPose p{.X_WO = X, .covariance = 1e-6 * Matrix6d::Identity()};
  return {p};
}

}  // namespace

TEST_CASE("The motion tells the true one of two poses, and the frames after it tell it better") {
  const CameraModel camera = VgaCamera("c", Pose{});
  cv::RNG rng(31);
  int frame_wrong = 0, causal_wrong = 0, offline_wrong = 0, nearest_wrong = 0, believed = 0, misled = 0,
      n = 0;
  for (int run = 0; run < 12; ++run) {
    PoseTrack track;
    std::vector<double> time;
    std::vector<std::vector<ObjectPose>> poses;
    std::vector<Pose> truth;
    Pose nearest;
    for (int i = 0; i < 150; ++i) {
      time.push_back(i * kDt);
      truth.push_back(Wandering(time.back(), 1.7 * run));
      poses.push_back(Seen(camera, truth.back(), rng, .15));
      REQUIRE(!poses.back().empty());
      const Verdict v = Judge(track.Update(time.back(), poses.back()));
      const auto wrong = [&](int h) { return h >= 0 && Gross(poses.back()[h].X_WO, truth.back()); };
      frame_wrong += wrong(0);
      causal_wrong += wrong(v.hypothesis);
      if (v.hypothesis >= 0 && v.p_wrong < .01) {
        ++believed;
        misled += wrong(v.hypothesis);
      }
      int near = 0;
      for (size_t h = 1; i > 0 && h < poses.back().size(); ++h) {
        if (AngleBetween(poses.back()[h].X_WO.q, nearest.q) <
            AngleBetween(poses.back()[near].X_WO.q, nearest.q)) {
          near = static_cast<int>(h);
        }
      }
      nearest = poses.back()[near].X_WO;
      nearest_wrong += wrong(near);
      ++n;
    }
    const auto evidence = PoseTrack::Revise(time, poses);
    for (size_t i = 0; i < time.size(); ++i) {
      const Verdict v = Judge(evidence[i]);
      offline_wrong += v.hypothesis >= 0 && Gross(poses[i][v.hypothesis].X_WO, truth[i]);
    }
  }
  INFO("wrong of " << n << ": each frame alone " << frame_wrong << ", nearest to the last " << nearest_wrong
                   << ", causal " << causal_wrong << ", offline " << offline_wrong << "; believed "
                   << believed << ", wrong of them " << misled);
  CHECK(frame_wrong > n / 50);  // else there is nothing to show
  CHECK(causal_wrong < .5 * frame_wrong);
  CHECK(causal_wrong < nearest_wrong);
  CHECK(offline_wrong < .7 * causal_wrong);
  CHECK(believed > n / 2);
  CHECK(misled <= believed / 200);
}

TEST_CASE("A pose that leaps away is an outlier at first, and where the object is when it stays there") {
  PoseTrack track;
  const Pose here{{.3, 0, 0}, Eigen::Quaterniond::Identity()};
  const Pose there{{.3, .2, 0}, ExpSO3({0, 0, 1})};
  double t = 0;
  const auto taken = [&](const Pose& X) { return Judge(track.Update(t += .04, Certain(X))).hypothesis == 0; };
  for (int i = 0; i < 5; ++i) CHECK(taken(here));
  CHECK_FALSE(taken(there));
  CHECK(taken(here));
  CHECK_FALSE(taken(there));
  CHECK_FALSE(taken(there));
  CHECK(taken(there));
  CHECK(taken(there));
}

TEST_CASE("Seen from after it, a wrong first pose is no pose") {
  std::vector<double> time;
  std::vector<std::vector<ObjectPose>> poses;
  for (int i = 0; i < 8; ++i) {
    time.push_back(.04 * i);
    poses.push_back(Certain({{i == 0 ? .8 : .3, 0, 0}, Eigen::Quaterniond::Identity()}));
  }
  PoseTrack track;
  CHECK(Judge(track.Update(time[0], poses[0])).hypothesis == 0);
  const auto evidence = PoseTrack::Revise(time, poses);
  CHECK(Judge(evidence[0]).hypothesis == -1);
  for (int i = 1; i < 8; ++i) CHECK(Judge(evidence[i]).hypothesis == 0);
}

TEST_CASE("A hand may take an object and put it down: quick motion is followed") {
  PoseTrack track;
  int taken = 0;
  for (int i = 0; i < 50; ++i) {  // 25 Hz, 1 s up and down by 0.3 m, peak 1.4 m/s^2 and 3 m/s^2 at the turns
    const double t = .04 * i;
    const Pose X{{.3, .1 * std::sin(4 * t), .15 - .15 * std::cos(2 * M_PI * t)},
                 ExpSO3({0, 0, std::sin(5 * t)})};
    taken += Judge(track.Update(t, Certain(X))).hypothesis == 0;
  }
  CHECK(taken == 50);
}

TEST_CASE("After half a second unseen an object may be anywhere") {
  PoseTrack track;
  for (int i = 0; i < 5; ++i) track.Update(.04 * i, Certain({{.3, 0, 0}, Eigen::Quaterniond::Identity()}));
  CHECK(track.Update(.3, {}).empty());
  const Verdict v = Judge(track.Update(.8, Certain({{-.3, .4, 0}, ExpSO3({0, 0, 2})})));
  CHECK(v.hypothesis == 0);
  CHECK(v.p_wrong < .01);
}
