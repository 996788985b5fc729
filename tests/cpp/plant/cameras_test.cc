// What the scene's cameras see, through the renderer.
#include <mujoco/mujoco.h>

extern "C" {
#include <apriltag/apriltag.h>
#include <apriltag/tag36h11.h>
}

#include <algorithm>
#include <catch2/catch.hpp>
#include <cstdlib>
#include <map>
#include <set>

#include "intabs/plant/renderer.h"
#include "intabs/plant/task.h"
#include "intabs/plant/viewer.h"
#include "plant/scripted_arm.h"

namespace intabs {
namespace {

const std::string kModels = INTABS_SOURCE_DIR "/models";
constexpr int kWidth = 640, kHeight = 480, kFocal = 610;

using Picture = std::vector<uint8_t>;

Picture Render(Renderer& renderer, const World& world, const std::string& camera) {
  Snapshot s;
  world.Save(s);
  Picture rgb(3 * kWidth * kHeight);
  renderer.Render(s, renderer.FindCamera(camera), rgb.data());
  return rgb;
}

// Centres of the tags in a picture, pixel centres at whole numbers.
std::map<int, Eigen::Vector2d> Tags(const Picture& rgb) {
  apriltag_family_t* family = tag36h11_create();
  apriltag_detector_t* detector = apriltag_detector_create();
  apriltag_detector_add_family_bits(detector, family, 0);
  detector->quad_decimate = 1;
  std::vector<uint8_t> green(kWidth * kHeight);
  for (size_t i = 0; i < green.size(); ++i) green[i] = rgb[3 * i + 1];
  image_u8_t gray = {kWidth, kHeight, kWidth, green.data()};
  zarray_t* found = apriltag_detector_detect(detector, &gray);
  std::map<int, Eigen::Vector2d> tags;
  for (int i = 0; i < zarray_size(found); ++i) {
    apriltag_detection_t* t;
    zarray_get(found, i, &t);
    if (t->decision_margin > 20) tags[t->id] = {t->c[0] - 0.5, t->c[1] - 0.5};
  }
  apriltag_detections_destroy(found);
  apriltag_detector_destroy(detector);
  tag36h11_destroy(family);
  return tags;
}

// A camera of the scene; MuJoCo's look along -z.
Pose CameraPose(const World& world, const std::string& name) {
  const mjModel* m = world.model().get();
  const int c = mj_name2id(m, mjOBJ_CAMERA, name.c_str());
  const mjtNum *p = m->cam_pos + 3 * c, *q = m->cam_quat + 4 * c;
  return {{p[0], p[1], p[2]}, Eigen::Quaterniond(q[0], q[1], q[2], q[3])};
}

Eigen::Vector2d Project(const Pose& X_WC, double focal, const Eigen::Vector3d& p_W) {
  const Eigen::Vector3d p = X_WC.Inverse() * p_W;
  return {(kWidth - 1) / 2.0 - focal * p.x() / p.z(), (kHeight - 1) / 2.0 + focal * p.y() / p.z()};
}

}  // namespace

TEST_CASE("Left and right see the ground tag, and between them every object, wherever it starts") {
  World world(kModels, "pick_place");
  Renderer renderer(world, kWidth, kHeight);
  CHECK(renderer.num_cameras() == 3);
  for (int seed = 0; seed < 10; ++seed) {
    world.Reset(seed, seed == 0 ? 0 : 4);
    CAPTURE(seed);
    std::set<int> seen;
    for (const std::string camera : {"left", "right"}) {
      CAPTURE(camera);
      const auto tags = Tags(Render(renderer, world, camera));
      for (const auto& [id, centre] : tags) seen.insert(id);
      REQUIRE(tags.count(0) == 1);
      // As a camera of f = 610 px at its place sees it.
      const Eigen::Vector2d wanted = Project(CameraPose(world, camera), kFocal, {0.52, 0, 0.001});
      CHECK((tags.at(0) - wanted).norm() < 0.5);
    }
    CHECK(std::any_of(seen.begin(), seen.end(), [](int id) { return id >= 10 && id <= 13; }));
    CHECK(seen.count(20) == 1);
    for (const int id : seen) CHECK(std::set<int>{0, 10, 11, 12, 13, 20}.count(id) == 1);
  }
}

TEST_CASE("In every task left and right see the ground tag, and between them every object at its start") {
  for (const std::string& task : TaskNames()) {
    World world(kModels, task);
    Renderer renderer(world, kWidth, kHeight);
    for (int seed = 0; seed < 3; ++seed) {
      world.Reset(seed, 5);
      CAPTURE(task, seed);
      std::set<int> seen;  // objects: their tags are numbered 10 (id + 1) + n
      for (const std::string camera : {"left", "right"}) {
        const auto tags = Tags(Render(renderer, world, camera));
        CHECK(tags.count(0) == 1);
        for (const auto& [id, centre] : tags) seen.insert(id / 10 - 1);
      }
      seen.erase(-1);
      std::set<int> there;
      for (const TrackedObject& o : world.Objects()) {
        if (o.id >= 0) there.insert(o.id);
      }
      CHECK(seen == there);
    }
  }
}

TEST_CASE("A tag of the block is seen while the arm carries it over the goal") {
  World world(kModels, "pick_place");
  Renderer renderer(world, kWidth, kHeight);
  test::ScriptedArm arm(world);
  arm.PickBlock(0.06);
  Pose over = world.Objects()[1].X_WO;
  over.p.z() += 0.082;
  arm.MoveTo(arm.Grasp(over), 1.5);
  std::set<int> seen;
  for (const std::string camera : {"left", "right"}) {
    for (const auto& [id, centre] : Tags(Render(renderer, world, camera))) seen.insert(id);
  }
  CHECK(std::any_of(seen.begin(), seen.end(), [](int id) { return id >= 10 && id <= 13; }));
  CHECK(seen.count(20) == 1);
}

TEST_CASE("Tags are neither so bright that white clips nor so dim that they drown") {
  World world(kModels, "pick_place");
  Renderer renderer(world, kWidth, kHeight);
  for (const std::string camera : {"left", "right"}) {
    const Picture rgb = Render(renderer, world, camera);
    for (const auto& [id, centre] : Tags(rgb)) {
      CAPTURE(camera, id);
      int lightest = 0, darkest = 255;
      const int reach = id == 0 ? 60 : 15;  // px
      for (int y = static_cast<int>(centre.y()) - reach; y <= centre.y() + reach; ++y) {
        for (int x = static_cast<int>(centre.x()) - reach; x <= centre.x() + reach; ++x) {
          const uint8_t v = rgb[3 * (y * kWidth + x) + 1];
          lightest = std::max<int>(lightest, v);
          darkest = std::min<int>(darkest, v);
        }
      }
      CHECK(lightest < 240);
      CHECK(lightest - darkest > 90);
    }
  }
}

TEST_CASE("The overview shows the whole arm at home and both objects") {
  World world(kModels, "pick_place");
  const mjModel* m = world.model().get();
  const Pose X_WC = CameraPose(world, "overview");
  const double fovy = m->cam_fovy[mj_name2id(m, mjOBJ_CAMERA, "overview")];
  const double focal = kHeight / 2.0 / std::tan(fovy / 2 * M_PI / 180);
  Snapshot s;
  world.Save(s);
  mjData* d = mj_makeData(m);
  std::copy(s.qpos.begin(), s.qpos.end(), d->qpos);
  mj_kinematics(m, d);
  int geoms = 0;
  for (int g = 0; g < m->ngeom; ++g) {
    const char* body = mj_id2name(m, mjOBJ_BODY, m->geom_bodyid[g]);
    if (m->geom_bodyid[g] == 0 || std::string(body) == "goal") continue;
    ++geoms;
    // Corners of the box about it: half sizes of a box, radius and half length of a cylinder.
    const mjtNum* size = m->geom_size + 3 * g;
    const bool cylinder = m->geom_type[g] == mjGEOM_CYLINDER;
    REQUIRE((cylinder || m->geom_type[g] == mjGEOM_BOX));
    const Eigen::Vector3d half(size[0], cylinder ? size[0] : size[1], cylinder ? size[1] : size[2]);
    const Eigen::Map<const Eigen::Vector3d> p(d->geom_xpos + 3 * g);
    const Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>> R(d->geom_xmat + 9 * g);
    for (int corner = 0; corner < 8; ++corner) {
      const Eigen::Vector3d sign(corner & 1 ? 1 : -1, corner & 2 ? 1 : -1, corner & 4 ? 1 : -1);
      const Eigen::Vector2d px = Project(X_WC, focal, p + R * sign.cwiseProduct(half));
      CAPTURE(body, px.x(), px.y());
      CHECK((px.x() > 0 && px.x() < kWidth - 1 && px.y() > 0 && px.y() < kHeight - 1));
    }
  }
  CHECK(geoms > 20);
  mj_deleteData(d);

  Renderer renderer(world, kWidth, kHeight);
  CHECK(Tags(Render(renderer, world, "overview")).count(0) == 1);
}

TEST_CASE("The same state gives the same picture, in another renderer too") {
  World world(kModels, "pick_place");
  Renderer first(world, kWidth, kHeight);
  const Picture before = Render(first, world, "left");
  {
    Renderer second(world, kWidth, kHeight);
    CHECK(Render(second, world, "left") == before);
  }
  CHECK(Render(first, world, "right") != before);
  CHECK(Render(first, world, "left") == before);
}

TEST_CASE("Without a display the viewer says so in one line, and pictures go on") {
  unsetenv("DISPLAY");
  unsetenv("WAYLAND_DISPLAY");
  World world(kModels, "pick_place");
  Renderer renderer(world, kWidth, kHeight);
  const Picture before = Render(renderer, world, "left");
  CHECK_THROWS_WITH(Viewer(world), Catch::Contains("without --viewer") && !Catch::Contains("\n"));
  CHECK(Render(renderer, world, "left") == before);
}

TEST_CASE("A camera that the scene lacks and pictures that do not fit are refused in one line") {
  World world(kModels, "pick_place");
  CHECK_THROWS_WITH(Renderer(world, 4000, 3000), Catch::Contains("4000x3000"));
  Renderer renderer(world, kWidth, kHeight);
  CHECK_THROWS_WITH(renderer.FindCamera("top"),
                    Catch::Contains("\"top\"") && Catch::Contains("left, right, overview"));
}

}  // namespace intabs
