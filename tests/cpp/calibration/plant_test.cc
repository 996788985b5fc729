// Places of cameras and arm from the plant's pictures, where the truth is known.
#include <mujoco/mujoco.h>

#include <catch2/catch.hpp>
#include <cstdio>
#include <functional>
#include <random>

#include "intabs/perception/calibration.h"
#include "intabs/perception/detector.h"
#include "intabs/perception/pipeline.h"
#include "intabs/plant/renderer.h"
#include "intabs/plant/world.h"

namespace intabs {
namespace {

const std::string kModels = std::string(INTABS_SOURCE_DIR) + "/models";
constexpr double kDegree = M_PI / 180;

// The plant's cameras, and a block that is put anywhere: a tag that an arm holds.
class Studio {
 public:
  Studio() : world_(kModels, "pick_place"), renderer_(world_, 640, 480) {
    config = LoadPerceptionConfig(kModels + "/config/perception.yaml");
    world_.Reset(0, 0);
    world_.Save(snapshot_);
    const mjModel* m = world_.model().get();
    block_ = m->jnt_qposadr[mj_name2id(m, mjOBJ_JOINT, "block")];
    mjData* d = mj_makeData(m);
    mj_kinematics(m, d);
    mj_camlight(m, d);
    for (CameraModel& c : config.cameras) {
      const int id = mj_name2id(m, mjOBJ_CAMERA, c.name.c_str());
      Eigen::Matrix3d R;
      for (int i = 0; i < 3; ++i) {
        for (int k = 0; k < 3; ++k) R(i, k) = d->cam_xmat[9 * id + 3 * i + k] * (k == 0 ? 1 : -1);
      }
      const double* p = d->cam_xpos + 3 * id;
      X_WC.push_back({{p[0], p[1], p[2]}, Eigen::Quaterniond(R).normalized()});
    }
    mj_deleteData(d);
  }

  void PutBlock(const Pose& X_WO) {
    double* q = snapshot_.qpos.data() + block_;
    for (int i = 0; i < 3; ++i) q[i] = X_WO.p[i];
    q[3] = X_WO.q.w();
    for (int i = 0; i < 3; ++i) q[4 + i] = X_WO.q.vec()[i];
  }

  // The corners of a tag, if the camera sees it; noise in grey levels.
  std::optional<TagCorners> See(int camera, int id, double noise, uint64_t seed) {
    cv::Mat rgb(480, 640, CV_8UC3), gray;
    renderer_.Render(snapshot_, renderer_.FindCamera(config.cameras[camera].name), rgb.data);
    RgbToGray(rgb, gray);
    cv::RNG random(seed);
    cv::Mat wide;
    gray.convertTo(wide, CV_32F);
    cv::Mat grain(gray.size(), CV_32F);
    random.fill(grain, cv::RNG::NORMAL, 0, noise);
    cv::Mat(wide + grain).convertTo(gray, CV_8U);
    TagDetector detector({id});
    for (const SeenTag& t : detector.Detect(gray, {}, true)) {
      if (t.id == id) return t.corners;
    }
    return std::nullopt;
  }

  PerceptionConfig config;
  std::vector<Pose> X_WC;  // the truth

 private:
  World world_;
  Renderer renderer_;
  Snapshot snapshot_;
  int block_ = 0;
};

std::string RefusalOf(const std::function<void()>& call) {
  try {
    call();
  } catch (const std::runtime_error& e) {
    CHECK(std::string(e.what()).find('\n') == std::string::npos);
    return e.what();
  }
  return "accepted";
}

// An arm whose base stands at X_WB holds tag 10 of the block at X_ET, in n poses that a camera sees.
struct Arm {
  Pose X_WB{{-0.35, 0.12, 0.03}, ExpSO3({0.02, -0.03, 0.6})};
  Pose X_ET{{0.01, -0.02, 0.09}, ExpSO3({0.3, 2.0, -0.4})};
};

std::vector<HandEyeSample> Samples(Studio& studio, const Arm& arm, int n, double turn, bool one_axis,
                                   uint64_t seed) {
  const Pose X_OT = studio.config.objects[0].tags[0].X_OT;
  std::mt19937_64 random(seed);
  std::uniform_real_distribution<double> unit(-1, 1);
  std::vector<HandEyeSample> samples;
  for (int i = 0; static_cast<int>(samples.size()) < n && i < 20 * n; ++i) {
    const Eigen::Vector3d place(0.45 + 0.12 * unit(random), 0.12 * unit(random), 0.12 + 0.08 * unit(random));
    // Faces a point between the cameras, then turned at random.
    const Eigen::Vector3d towards = (0.5 * (studio.X_WC[0].p + studio.X_WC[1].p) - place).normalized();
    Eigen::Matrix3d R;
    R.col(2) = -towards;
    R.col(0) = Eigen::Vector3d::UnitZ().cross(towards).normalized();
    R.col(1) = R.col(2).cross(R.col(0));
    const Eigen::Vector3d w =
        one_axis ? Eigen::Vector3d(0, 0, turn * unit(random))
                 : Eigen::Vector3d(turn * unit(random), turn * unit(random), turn * unit(random));
    Pose X_WT{place, (Eigen::Quaterniond(R) * ExpSO3(w)).normalized()};
    if (one_axis) X_WT.q = (ExpSO3({0, 0, w.z()}) * Eigen::Quaterniond(-0.5, 0.5, 0.5, -0.5)).normalized();
    studio.PutBlock(X_WT * X_OT.Inverse());
    HandEyeSample s;
    s.name = std::to_string(i);
    s.X_BE = arm.X_WB.Inverse() * X_WT * arm.X_ET.Inverse();
    for (int c = 0; c < 2; ++c) {
      if (const auto corners = studio.See(c, 10, 2, seed * 1000 + i)) s.views.push_back({c, *corners});
    }
    if (!s.views.empty() || one_axis) samples.push_back(s);
  }
  return samples;
}

std::vector<PlacedCamera> Placed(const Studio& studio) {
  std::vector<PlacedCamera> out;
  for (size_t c = 0; c < studio.X_WC.size(); ++c)
    out.push_back({&studio.config.cameras[c], studio.X_WC[c], {}});
  return out;
}

}  // namespace

TEST_CASE(
    "Both cameras of the plant are found within 1 mm and 0.1 degree from 50 noisy frames of the ground tag") {
  Studio studio;
  for (int c = 0; c < 2; ++c) {
    std::vector<TagCorners> frames;
    for (int i = 0; i < 50; ++i) {
      if (const auto corners = studio.See(c, studio.config.ground->id, 2, i)) frames.push_back(*corners);
    }
    const Extrinsics r = CalibrateExtrinsics(studio.config.cameras[c], *studio.config.ground, frames);
    const double mm = 1e3 * (r.X_WC.p - studio.X_WC[c].p).norm();
    const double deg = AngleBetween(r.X_WC.q, studio.X_WC[c].q) / kDegree;
    std::printf("camera %s: %d frames, off by %.2f mm %.3f deg, said sigma %.2f mm %.3f deg, rms %.3f px\n",
                studio.config.cameras[c].name.c_str(), r.frames, mm, deg, 1e3 * r.sigma_m,
                r.sigma_rad / kDegree, r.rms_px);
    CHECK(mm < 1);
    CHECK(deg < 0.1);
    CHECK(mm < 4e3 * r.sigma_m);
    CHECK(deg < 4 * r.sigma_rad / kDegree);
  }
}

TEST_CASE("Frames of the ground tag that cannot tell where the camera stands are refused with the reason") {
  Studio studio;
  const CameraModel& camera = studio.config.cameras[0];
  const GroundTag& ground = *studio.config.ground;
  std::vector<TagCorners> frames(20, *studio.See(0, ground.id, 0, 0));
  const auto refusal = [&](const GroundTag& g, const std::vector<TagCorners>& f) {
    return RefusalOf([&] { CalibrateExtrinsics(camera, g, f); });
  };
  CHECK_THAT(refusal(ground, {frames.begin(), frames.begin() + 9}), Catch::Contains("9 frames"));
  std::vector<TagCorners> moved = frames;
  for (size_t i = 0; i < moved.size(); i += 3) {
    for (auto& corner : moved[i]) corner.x() += 5;
  }
  CHECK_THAT(refusal(ground, moved), Catch::Contains("must stand still"));
  std::vector<TagCorners> bent = frames;
  for (TagCorners& f : bent) f[2] += Eigen::Vector2d(6, -6);
  CHECK_THAT(refusal(ground, bent), Catch::Contains("off by"));
  std::vector<TagCorners> tiny = frames;
  for (TagCorners& f : tiny) {
    for (auto& corner : f) corner = 0.1 * corner;
  }
  CHECK_THAT(refusal(ground, tiny), Catch::Contains("px long"));
}

TEST_CASE(
    "The arm's base is found within 1.5 mm and 0.15 degree from a tag that the arm shows to the cameras") {
  Studio studio;
  const Arm arm;
  for (const uint64_t seed : {1, 2, 3}) {
    const auto samples = Samples(studio, arm, 20, 0.7, false, seed);
    REQUIRE(samples.size() == 20);
    const HandEye r = CalibrateHandEye(Placed(studio), 0.032, samples);
    const double mm = 1e3 * (r.X_WB.p - arm.X_WB.p).norm(),
                 deg = AngleBetween(r.X_WB.q, arm.X_WB.q) / kDegree;
    std::printf(
        "hand-eye, seed %d: %d poses (%zu left out), base off by %.2f mm %.3f deg, said sigma %.2f mm %.3f "
        "deg, "
        "tag off by %.2f mm, rms %.3f px, %.2f mm\n",
        static_cast<int>(seed), r.samples, r.dropped.size(), mm, deg, 1e3 * r.sigma_m, r.sigma_rad / kDegree,
        1e3 * (r.X_ET.p - arm.X_ET.p).norm(), r.rms_px, 1e3 * r.rms_m);
    CHECK(mm < 1.5);
    CHECK(deg < 0.15);
    CHECK((r.X_ET.p - arm.X_ET.p).norm() < 0.0015);
  }
}

TEST_CASE("Arm poses that do not fit the others are left out and named") {
  Studio studio;
  const Arm arm;
  auto samples = Samples(studio, arm, 20, 0.7, false, 4);
  samples[7].X_BE.p.x() += 0.03;
  samples[7].name = "the bad one";
  const HandEye r = CalibrateHandEye(Placed(studio), 0.032, samples);
  CHECK(std::count(r.dropped.begin(), r.dropped.end(), "the bad one") == 1);
  CHECK((r.X_WB.p - arm.X_WB.p).norm() < 0.002);
}

TEST_CASE("Arm poses that cannot tell where the arm stands are refused with the reason") {
  Studio studio;
  const Arm arm;
  const auto placed = Placed(studio);
  const auto refusal = [&](double size, const std::vector<HandEyeSample>& samples) {
    return RefusalOf([&] { CalibrateHandEye(placed, size, samples); });
  };
  auto good = Samples(studio, arm, 12, 0.7, false, 5);
  CHECK_THAT(refusal(0.032, {good.begin(), good.begin() + 7}), Catch::Contains("7 arm poses show the tag"));
  auto alike = good;
  for (HandEyeSample& s : alike) s.X_BE.q = good[0].X_BE.q;
  CHECK_THAT(refusal(0.032, alike), Catch::Contains("too similar"));
  auto one_axis = good;
  for (size_t i = 0; i < one_axis.size(); ++i)
    one_axis[i].X_BE.q = ExpSO3({0, 0, 0.2 * static_cast<double>(i)});
  CHECK_THAT(refusal(0.032, one_axis), Catch::Contains("one axis alone"));
  CHECK_THAT(refusal(0.05, good), Catch::Contains("do not agree"));  // a wrong tag size
}

}  // namespace intabs
