#include "intabs/perception/pipeline.h"

#include <algorithm>
#include <catch2/catch.hpp>
#include <cmath>
#include <opencv2/core.hpp>

#include "perception/synthetic.h"

using namespace intabs;
using test::LookAt;
using test::Scene;
using test::View;

namespace {

constexpr int64_t kFrameUs = 40000;
const Pose kFlatTag{Eigen::Vector3d::Zero(), Eigen::Quaterniond(0, 1, 0, 0)};  // on its back, printed side up

// A tag on the side of a cube of 44 mm whose outward normal lies at `azimuth`.
Pose OnSide(double azimuth) {
  const Eigen::Vector3d out(std::cos(azimuth), std::sin(azimuth), 0);
  Eigen::Matrix3d R;
  R.col(2) = -out;
  R.col(1) = -Eigen::Vector3d::UnitZ();
  R.col(0) = R.col(1).cross(R.col(2));
  return {0.023 * out, Eigen::Quaterniond(R)};
}

PerceptionConfig TwoCameras() {
  PerceptionConfig config;
  for (const double y : {0.35, -0.35}) {
    CameraModel camera = test::VgaCamera(y > 0 ? "left" : "right", {});
    camera.X_WC.reset();
    config.cameras.push_back(camera);
  }
  config.ground = GroundTag{0, 0.12, {{.45, 0, 0}, kFlatTag.q}};
  ObjectModel block{.slot = 0, .id = 0, .name = "block", .tags = {}};
  for (int i = 0; i < 4; ++i) block.tags.push_back({10 + i, 0.032, OnSide(i * M_PI / 2)});
  ObjectModel goal{.slot = 1, .id = 1, .name = "goal", .tags = {{20, 0.04, {{.06, 0, .001}, kFlatTag.q}}}};
  config.objects = {block, goal};
  return config;
}

struct World {
  PerceptionConfig config = TwoCameras();
  Pose block{{.28, -.07, .022}, ExpSO3({0, 0, -.26})};
  Pose goal{{.29, .08, 0}, ExpSO3({0, 0, .26})};
  uint64_t seed = 1;

  Scene Tags() const {
    Scene scene{{0, {config.ground->X_WT, config.ground->size}}};
    for (const ObjectTag& t : config.objects[0].tags) scene[t.id] = {block * t.X_OT, t.size};
    for (const ObjectTag& t : config.objects[1].tags) scene[t.id] = {goal * t.X_OT, t.size};
    return scene;
  }
  CameraModel Placed(int camera) const {
    CameraModel model = config.cameras[camera];
    model.X_WC = LookAt({.85, camera == 0 ? .35 : -.35, .55}, {.34, 0, .05});
    return model;
  }
  GrayImages See() { return See(Tags()); }
  GrayImages See(const Scene& scene) {
    GrayImages images;
    for (int c = 0; c < 2; ++c) images.push_back(View(Placed(c), scene, seed++, {.blur_px = .7, .noise = 2}));
    return images;
  }
};

double Millimetres(const TrackedObject& o, const Pose& truth) { return 1e3 * (o.X_WO.p - truth.p).norm(); }
double Degrees(const TrackedObject& o, const Pose& truth) {
  return AngleBetween(o.X_WO.q, truth.q) * 180 / M_PI;
}

}  // namespace

TEST_CASE("Objects that move are found where they are, in W, from the first frame on") {
  World world;
  Pipeline pipeline(world.config);
  ObjectPoses poses;
  CameraDetections seen;
  cv::RNG rng(17);
  for (int i = 0; i < 12; ++i) {
    world.block.p += Eigen::Vector3d(rng.uniform(-.01, .01), rng.uniform(-.01, .01), rng.uniform(0., .01));
    world.block.q = world.block.q * ExpSO3({rng.uniform(-.05, .05), rng.uniform(-.05, .05), .1});
    pipeline.Process(world.See(), i + 1, i * kFrameUs, poses, seen);
    INFO("frame " << i << ": block " << Millimetres(poses.objects[0], world.block) << " mm, "
                  << Degrees(poses.objects[0], world.block) << " deg; goal "
                  << Millimetres(poses.objects[1], world.goal) << " mm, "
                  << Degrees(poses.objects[1], world.goal));
    CHECK(poses.frame_seq == i + 1);
    CHECK(poses.exposure_utime == i * kFrameUs);
    for (int o = 0; o < 2; ++o) {
      CHECK(poses.objects[o].id == o);
      CHECK(poses.objects[o].valid);
      CHECK(poses.objects[o].cameras == 3);
      CHECK(poses.objects[o].age == 0);
    }
    CHECK(Millimetres(poses.objects[0], world.block) < 3);
    CHECK(Degrees(poses.objects[0], world.block) < 2);
    CHECK(Millimetres(poses.objects[1], world.goal) < 3);
    CHECK(Degrees(poses.objects[1], world.goal) < 2);
    for (int o = 2; o < kMaxObjects; ++o) {
      CHECK(poses.objects[o].id == -1);
      CHECK_FALSE(poses.objects[o].valid);
    }
    CHECK(seen[0].n >= 3);  // ground, goal, a side of the block
    CHECK(seen[2].n == 0);
  }
  for (int c = 0; c < 2; ++c) {
    CHECK((pipeline.X_WC(c)->p - world.Placed(c).X_WC->p).norm() < 0.005);
    CHECK(AngleBetween(pipeline.X_WC(c)->q, world.Placed(c).X_WC->q) < 0.005);
  }
}

TEST_CASE("Without tags a pose is foretold for half a second with growing covariance, then invalid") {
  World world;
  Pipeline pipeline(world.config);
  ObjectPoses poses;
  CameraDetections seen;
  const Eigen::Vector3d velocity(0, .2, .1);  // [m/s]
  const Eigen::Vector3d rate(0, 0, .5);       // [rad/s], in O
  const double period = 1e-6 * kFrameUs;
  const bool moves = GENERATE(false, true);
  const auto step = [&] {
    if (!moves) return;
    world.block.p += period * velocity;
    world.block.q = (world.block.q * ExpSO3(period * rate)).normalized();
  };
  int64_t t = 0;
  for (int i = 0; i < 8; ++i, t += kFrameUs, step()) pipeline.Process(world.See(), i + 1, t, poses, seen);
  const TrackedObject& block = poses.objects[0];
  REQUIRE(block.valid);
  REQUIRE(block.age == 0);
  const TrackedObject last = block;
  const GrayImages empty = world.See({});
  double sigma = last.covariance[15], sigma_angle = last.covariance[0];  // variances
  Pose at_end;
  for (int i = 1; i <= 20; ++i, t += kFrameUs, step()) {
    pipeline.Process(empty, i + 8, t, poses, seen);
    INFO("moves " << moves << ", frame " << i << " of the gap: " << Millimetres(block, world.block) << " mm, "
                  << Degrees(block, world.block) << " deg");
    CHECK(seen[0].n == 0);
    CHECK(block.age == Approx(.04 * i));
    CHECK(block.valid == (i <= 12));
    CHECK(block.cameras == 0);
    if (i <= 12) {
      CHECK(block.covariance[15] > sigma);
      CHECK(block.covariance[0] > sigma_angle);
      Matrix6d C;
      for (int row = 0, n = 0; row < 6; ++row) {
        for (int col = row; col < 6; ++col) C(row, col) = C(col, row) = block.covariance[n++];
      }
      Vector6d e;
      e << LogSO3(world.block.q * block.X_WO.q.conjugate()), world.block.p - block.X_WO.p;
      CHECK(e.dot(C.ldlt().solve(e)) < 12.592);
      if (moves) {
        CHECK(Millimetres(block, world.block) < .6 * Millimetres(last, world.block));
        CHECK(Degrees(block, world.block) < .8 * Degrees(last, world.block));
      } else {
        CHECK(Millimetres(block, world.block) < 4);
        CHECK(Degrees(block, world.block) < 2);
      }
      at_end = block.X_WO;
    } else {
      CHECK((block.X_WO.p - at_end.p).norm() < .005);  // it stays where it was foretold last
    }
    sigma = block.covariance[15];
    sigma_angle = block.covariance[0];
  }
  if (moves) return;
  for (int i = 21; i < 29; ++i, t += kFrameUs) pipeline.Process(world.See(), i + 8, t, poses, seen);
  CHECK(block.valid);  // found again
  CHECK(block.age == 0);
}

TEST_CASE("Frames without tags give invalid objects with a null pose, never a guess") {
  World world;
  Pipeline pipeline(world.config);
  ObjectPoses poses;
  CameraDetections seen;
  const cv::Mat black(480, 640, CV_8UC1, cv::Scalar(0));
  int64_t t = 0;
  for (const GrayImages& images :
       {GrayImages{black, black}, world.See({}), GrayImages{cv::Mat(), cv::Mat()}}) {
    pipeline.Process(images, 1, t += kFrameUs, poses, seen);
    for (int o = 0; o < 2; ++o) {
      CHECK(poses.objects[o].id == -1);
      CHECK_FALSE(poses.objects[o].valid);
      CHECK(poses.objects[o].X_WO.p.norm() == 0);
    }
  }
}

TEST_CASE("Without the ground tag no object has a pose in W") {
  World world;
  Pipeline pipeline(world.config);
  ObjectPoses poses;
  CameraDetections seen;
  Scene scene = world.Tags();
  scene.erase(0);
  pipeline.Process(world.See(scene), 1, 0, poses, seen);
  CHECK(seen[0].n > 0);
  CHECK_FALSE(poses.objects[0].valid);
  CHECK_FALSE(pipeline.X_WC(0).has_value());
}

TEST_CASE("Swapped, black, missing and torn images never give a wrong pose that is called valid") {
  World world;
  Pipeline pipeline(world.config);
  ObjectPoses poses;
  CameraDetections seen;
  int64_t t = 0;
  for (int i = 0; i < Pipeline::kGroundFrames; ++i)
    pipeline.Process(world.See(), 1, t += kFrameUs, poses, seen);
  const bool with_ground = GENERATE(true, false);  // the arm may hide the ground tag
  GrayImages before = world.See();
  for (int i = 0; i < 20; ++i) {
    world.block.p.y() += .01;
    Scene scene = world.Tags();
    if (!with_ground) scene.erase(0);
    GrayImages images = world.See(scene);
    const GrayImages whole = {images[0].clone(), images[1].clone()};
    switch (i % 5) {
      case 0:
        std::swap(images[0], images[1]);
        break;
      case 1:
        images[0] = cv::Mat(480, 640, CV_8UC1, cv::Scalar(0));
        break;
      case 2:
        images[1] = cv::Mat();
        break;
      case 3:
        images[0] = images[1].clone();
        break;
      case 4:  // torn: the upper part is still the picture before
        before[0].rowRange(0, 200 + 3 * i).copyTo(images[0].rowRange(0, 200 + 3 * i));
        break;
    }
    before = whole;
    pipeline.Process(images, 1, t += kFrameUs, poses, seen);
    const TrackedObject& o = poses.objects[0];
    INFO("frame " << i << ", ground tag " << with_ground << ", cameras " << int(o.cameras));
    if (o.valid && o.age == 0) CHECK(Millimetres(o, world.block) < 8);
    if (i % 5 == 0) CHECK(o.age > 0);
    if (with_ground && i % 5 == 3) CHECK_FALSE(pipeline.in_place(0));
  }
}

TEST_CASE("A camera that shows the ground tag elsewhere than before is not believed") {
  World world;
  Pipeline pipeline(world.config);
  ObjectPoses poses;
  CameraDetections seen;
  int64_t t = 0;
  for (int i = 0; i < Pipeline::kGroundFrames; ++i)
    pipeline.Process(world.See(), 1, t += kFrameUs, poses, seen);
  const GrayImages images = world.See();
  // The left picture from the right camera's cable, and nothing from the left one that could contradict it.
  pipeline.Process({cv::Mat(), images[0]}, 1, t += kFrameUs, poses, seen);
  CHECK(seen[1].n > 0);
  CHECK_FALSE(pipeline.in_place(1));
  CHECK(poses.objects[0].age > 0);
  // Moved for good: asked to, the pipeline finds its new place.
  pipeline.RedoExtrinsics();
  pipeline.Process({cv::Mat(), images[0]}, 1, t += kFrameUs, poses, seen);
  CHECK(poses.objects[0].age == 0);
  CHECK(Millimetres(poses.objects[0], world.block) < 8);
  CHECK((pipeline.X_WC(1)->p - world.Placed(0).X_WC->p).norm() < 0.005);
}

TEST_CASE("One camera alone still gives the block, by the tags it sees") {
  World world;
  Pipeline pipeline(world.config);
  ObjectPoses poses;
  CameraDetections seen;
  std::vector<double> mm;
  for (int i = 0; i < 20; ++i) {
    world.block.q = ExpSO3({0, 0, .3 * i});
    GrayImages images = world.See();
    if (i > 0) images[1] = cv::Mat();
    pipeline.Process(images, 1, i * kFrameUs, poses, seen);
    if (poses.objects[0].age == 0) mm.push_back(Millimetres(poses.objects[0], world.block));
  }
  REQUIRE(mm.size() >= 15);
  CHECK(*std::max_element(mm.begin(), mm.end()) < 12);
}

TEST_CASE("The same frames give the same poses, bit for bit, again and after a reset") {
  World world;
  std::vector<GrayImages> frames;
  for (int i = 0; i < 8; ++i) {
    world.block.p.x() += .012;
    frames.push_back(i == 4 ? world.See({}) : world.See());
  }
  Pipeline a(world.config), b(world.config);
  CameraDetections seen;
  const auto run = [&](Pipeline& p) {
    std::vector<double> out;
    ObjectPoses poses;
    for (size_t i = 0; i < frames.size(); ++i) {
      p.Process(frames[i], i + 1, i * kFrameUs, poses, seen);
      for (const TrackedObject& o : poses.objects) {
        for (int k = 0; k < 3; ++k) out.push_back(o.X_WO.p[k]);
        for (int k = 0; k < 4; ++k) out.push_back(o.X_WO.q.coeffs()[k]);
        out.push_back(o.age);
        out.push_back(o.covariance[0]);
      }
    }
    return out;
  };
  const auto first = run(a);
  CHECK(run(b) == first);
  a.Reset();
  CHECK(run(a) == first);
}

TEST_CASE("With the whole run in view, poses are at least as many and none is worse") {
  World world;
  Pipeline pipeline(world.config, {.revisable = true});
  ObjectPoses poses;
  CameraDetections seen;
  std::vector<ObjectPoses> causal;
  std::vector<Pose> truth;
  for (int i = 0; i < 14; ++i) {
    world.block.p.y() += .008;
    truth.push_back(world.block);
    GrayImages images = world.See(i == 6 ? Scene{} : world.Tags());
    if (i % 3 == 1) images[0] = cv::Mat();
    pipeline.Process(images, i + 1, i * kFrameUs, poses, seen);
    causal.push_back(poses);
  }
  const auto revised = pipeline.Revised();
  REQUIRE(revised.size() == causal.size());
  for (size_t i = 0; i < causal.size(); ++i) {
    INFO("frame " << i);
    CHECK(revised[i].frame_seq == causal[i].frame_seq);
    CHECK(revised[i].exposure_utime == causal[i].exposure_utime);
    const TrackedObject &a = causal[i].objects[0], &b = revised[i].objects[0];
    if (a.age == 0) CHECK(b.age == 0);
    CHECK((b.age > 0) == (i == 6));
    CHECK(b.valid);
    CHECK(Millimetres(b, truth[i]) < 6);  // one camera alone in some of them, none at all in one
    if (b.age > 0) {
      CHECK(b.cameras == 0);
      CHECK(b.covariance[15] > revised[i - 1].objects[0].covariance[15]);
      CHECK(b.covariance[0] > revised[i - 1].objects[0].covariance[0]);
    }
    CHECK(revised[i].objects[1].valid);
    CHECK(revised[i].objects[2].id == -1);
  }
  CHECK(Pipeline(world.config).Revised().empty());
}

TEST_CASE("With the whole run in view a gap of half a second is filled from both sides, a longer one never") {
  const bool longer = GENERATE(false, true);
  World world;
  Pipeline pipeline(world.config, {.revisable = true});
  ObjectPoses poses;
  CameraDetections seen;
  std::vector<ObjectPoses> causal;
  std::vector<Pose> truth;
  const int first = 8, n = longer ? 12 : 11, frames = 30;  // 13 and 12 steps of 40 ms between the poses
  for (int i = 0; i < frames; ++i) {
    const double x = i / (frames - 1.);  // a reach
    world.block.p = Eigen::Vector3d(.28, -.12 + .25 * x * x * x * (10 - 15 * x + 6 * x * x), .022);
    truth.push_back(world.block);
    const bool hidden = (i >= first && i < first + n) || i == frames - 1;
    pipeline.Process(world.See(hidden ? Scene{} : world.Tags()), i + 1, i * kFrameUs, poses, seen);
    causal.push_back(poses);
  }
  const auto revised = pipeline.Revised();
  double filled = 0, foretold = 0;
  for (int i = first; i < first + n; ++i) {
    INFO("frame " << i);
    const TrackedObject& o = revised[i].objects[0];
    CHECK(o.valid == !longer);
    CHECK(o.age == Approx(.04 * (i - first + 1)));
    filled = std::max(filled, Millimetres(o, truth[i]));
    foretold = std::max(foretold, Millimetres(causal[i].objects[0], truth[i]));
    if (!longer) CHECK((o.X_WO.p - truth[i].p).norm() < 3 * std::sqrt(3 * o.covariance[15]));
  }
  CAPTURE(filled, foretold);
  if (!longer) CHECK(filled < .25 * foretold);
  CHECK_FALSE(revised.back().objects[0].valid);  // what comes after it is not known
}

TEST_CASE("Images that do not fit the configuration are refused with the sizes") {
  World world;
  Pipeline pipeline(world.config);
  ObjectPoses poses;
  CameraDetections seen;
  CHECK_THROWS_WITH(pipeline.Process({cv::Mat(480, 640, CV_8UC1)}, 1, 0, poses, seen),
                    Catch::Contains("1 images for 2 cameras"));
  CHECK_THROWS_WITH(pipeline.Process({cv::Mat(240, 320, CV_8UC1), cv::Mat()}, 1, 0, poses, seen),
                    Catch::Contains("320 x 240") && Catch::Contains("640 x 480"));
  CHECK_THROWS_WITH(pipeline.Process({cv::Mat(480, 640, CV_8UC3), cv::Mat()}, 1, 0, poses, seen),
                    Catch::Contains("CV_8UC1"));
}

TEST_CASE("The covariance tells how far the poses are off") {
  // Many corner draws for one geometry: the spread of the solutions against the covariance that the solver
  // states.
  World world;
  cv::RNG rng(23);
  std::vector<CameraModel> models{world.Placed(0), world.Placed(1)};
  std::vector<PlacedCamera> placed{{&models[0], *models[0].X_WC}, {&models[1], *models[1].X_WC}};
  int inside = 0;
  const int n = 400;
  for (int i = 0; i < n; ++i) {
    std::vector<TagView> views;
    for (int c = 0; c < 2; ++c) {
      for (const ObjectTag& t : world.config.objects[0].tags) {
        const Pose X_CT = placed[c].X_WC.Inverse() * world.block * t.X_OT;
        if ((X_CT.q * Eigen::Vector3d::UnitZ()).dot(X_CT.p.normalized()) < .3) continue;
        TagCorners corners;
        for (int k = 0; k < 4; ++k) {
          corners[k] = models[c].Project(X_CT * TagPoints(t.size)[k]) +
                       Eigen::Vector2d(rng.gaussian(.2), rng.gaussian(.2));
        }
        views.push_back({c, t.size, t.X_OT, corners, SolveTag(models[c], t.size, corners),
                         .2 * .2 * Matrix8d::Identity()});
      }
    }
    const ObjectFit fit = SolveObject(placed, views, {});
    REQUIRE(fit.valid);
    Vector6d e;
    const ObjectPose& best = fit.minima[0];
    e << LogSO3(world.block.q * best.X_WO.q.conjugate()), world.block.p - best.X_WO.p;
    inside += e.dot(best.covariance.ldlt().solve(e)) < 12.592;  // chi-square, 6 degrees of freedom, 95 %
  }
  INFO(inside << " of " << n << " inside the 95 % ellipsoid");
  CHECK(inside >= 0.9 * n);
  CHECK(inside <= 0.98 * n);
}
