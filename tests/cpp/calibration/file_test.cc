// What calibration writes is what perception reads.
#include <unistd.h>

#include <catch2/catch.hpp>
#include <filesystem>
#include <fstream>

#include "intabs/perception/config.h"

namespace intabs {
namespace {

struct Folder {
  Folder() { std::filesystem::create_directory(path); }
  ~Folder() { std::filesystem::remove_all(path); }
  const std::string path =
      std::filesystem::temp_directory_path() / ("intabs_calibration_" + std::to_string(getpid()));
};

constexpr char kRest[] = R"(lcm: udpm://239.255.76.67:7667?ttl=0
ring: /elsewhere
objects:
  - {slot: 0, id: 0, name: block, tags: [{id: 10, size: 0.03, X_OT: {p: [0, 0, 0], q: [1, 0, 0, 0]}}]}
)";

Calibration Sample() {
  Calibration c;
  Calibration::Camera& camera = c.cameras.emplace_back();
  camera.model.name = "left";
  camera.model.width = 640;
  camera.model.height = 480;
  camera.model.fx = 610.12345678901234;
  camera.model.fy = 1e2 / 3 * 18;
  camera.model.cx = 319.5;
  camera.model.cy = 240;
  camera.model.distortion = {-0.1, 1e-5, 3e-17, -2.5e-4, 0.125};
  camera.model.X_WC = Pose{{0.1, -0.2, 1.0 / 3}, Eigen::Quaterniond(1, 2, -3, 4).normalized()};
  camera.model.source = "v4l2:/dev/video0";
  camera.intrinsics = {{"date", "2026-01-31"}, {"pictures", "17"}, {"rms_px", "0.25"}};
  c.X_WB = Pose{{-0.5, 1e-4, 0}, Eigen::Quaterniond(0.1, 0, 0, 1).normalized()};
  c.hand_eye = {{"date", "2026-02-01"}, {"rms_mm", "0.5"}};
  return c;
}

void Write(const std::string& path, const std::string& text) { std::ofstream(path) << text; }

}  // namespace

TEST_CASE("A calibration is read as it was written, number for number") {
  const Folder folder;
  const std::string path = folder.path + "/c.yaml";
  const Calibration a = Sample();
  SaveCalibration(path, a);
  const Calibration b = LoadCalibration(path);
  REQUIRE(b.cameras.size() == 1);
  const CameraModel &m = a.cameras[0].model, &n = b.cameras[0].model;
  CHECK(n.name == m.name);
  CHECK(n.fx == m.fx);
  CHECK(n.fy == m.fy);
  CHECK(n.distortion == m.distortion);
  CHECK(n.source == m.source);
  CHECK(n.X_WC->p == m.X_WC->p);
  CHECK(AngleBetween(n.X_WC->q, m.X_WC->q) < 1e-12);
  CHECK(b.cameras[0].intrinsics == a.cameras[0].intrinsics);
  CHECK(b.X_WB->p == a.X_WB->p);
  CHECK(b.hand_eye == a.hand_eye);
}

TEST_CASE(
    "A configuration takes cameras and arm base from the calibration it names, and options are passed over") {
  const Folder folder;
  SaveCalibration(folder.path + "/c.yaml", Sample());
  Write(folder.path + "/p.yaml", std::string("calibration: c.yaml\n") + kRest);
  const PerceptionConfig config = LoadPerceptionConfig(folder.path + "/p.yaml");
  REQUIRE(config.cameras.size() == 1);
  CHECK(config.cameras[0].distortion[4] == 0.125);
  CHECK(config.cameras[0].source == "v4l2:/dev/video0");
  CHECK(config.X_WB.p.x() == -0.5);
}

TEST_CASE("Without X_WB the arm's base is W") {
  const Folder folder;
  Calibration c = Sample();
  c.X_WB.reset();
  SaveCalibration(folder.path + "/c.yaml", c);
  Write(folder.path + "/p.yaml", std::string("calibration: c.yaml\n") + kRest);
  const Pose X_WB = LoadPerceptionConfig(folder.path + "/p.yaml").X_WB;
  CHECK(X_WB.p == Eigen::Vector3d::Zero());
  CHECK(X_WB.q.w() == 1);
}

TEST_CASE("A calibration that does not hold is refused in one line that names file and key") {
  const Folder folder;
  const auto refused = [&](const std::string& calibration, const std::string& head, const std::string& part) {
    Write(folder.path + "/c.yaml", calibration);
    Write(folder.path + "/p.yaml", head + kRest);
    try {
      LoadPerceptionConfig(folder.path + "/p.yaml");
      FAIL("was accepted");
    } catch (const std::runtime_error& e) {
      const std::string what = e.what();
      INFO(what);
      CHECK_THAT(what, Catch::Contains("p.yaml: ") && Catch::Contains(part));
      CHECK(what.find('\n') == std::string::npos);
    }
  };
  const std::string camera =
      "cameras:\n  - {name: a, width: 640, height: 480, fx: 600, fy: 600, cx: 320, cy: 240";
  refused(camera + ", distortion: [1, 2]}\n", "calibration: c.yaml\n",
          "c.yaml: cameras[0].distortion: expected 5");
  refused(camera + ", k1: 1}\n", "calibration: c.yaml\n", "unknown key \"k1\"");
  refused(camera + ", intrinsics: 3}\n", "calibration: c.yaml\n", "cameras[0].intrinsics");
  refused("X_WB: {p: [0, 0, 0]}\n", "calibration: c.yaml\n", "X_WB: \"q\" is missing");
  refused("", "calibration: none.yaml\n", "none.yaml: cannot be read");
  refused("", "calibration: c.yaml\nX_WB: {p: [0, 0, 0], q: [1, 0, 0, 0]}\n", "take them out");
  refused(camera + ", distortion: [-3, 0, 0, 0, 0], X_WC: {p: [0, 0, 1], q: [1, 0, 0, 0]}}\n",
          "calibration: c.yaml\n", "camera a: the distortion cannot be undone");
  refused("cameras: [\n", "calibration: c.yaml\n", "c.yaml: not readable as YAML: line 2");
}

}  // namespace intabs
