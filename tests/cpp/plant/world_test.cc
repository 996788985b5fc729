#include "intabs/plant/world.h"

#include <mujoco/mujoco.h>
#include <unistd.h>

#include <catch2/catch.hpp>
#include <filesystem>
#include <fstream>
#include <functional>
#include <iostream>
#include <set>

#include "intabs/plant/task.h"
#include "plant/scripted_arm.h"

namespace intabs {
namespace {

const std::string kModels = INTABS_SOURCE_DIR "/models";
constexpr double kDegree = M_PI / 180;

double Yaw(const Pose& X) { return LogSO3(X.q).z(); }

double WrappedAngle(double a) { return std::remainder(a, 2 * M_PI); }

// A motion that swings all joints and works the gripper. Returns the hash at its end.
uint64_t Swing(World& world, int64_t seed, int ticks) {
  world.Reset(seed, 3);
  ServoTarget target;
  for (int i = 0; i < ticks; ++i) {
    const double t = 0.004 * i;
    for (int k = 0; k < kNumJoints; ++k) {
      const double amplitude = 0.25, w = 1 + 0.3 * k;
      target.q[k] = World::Home()[k] + amplitude * std::sin(w * t);
      target.dq[k] = amplitude * w * std::cos(w * t);
    }
    target.gripper_closed = std::fmod(t, 2) > 1;
    world.Step(target);
  }
  return world.StateHash();
}

// Geoms in contact in a state, by name.
std::set<std::string> PairsInContact(const World& world) {
  Snapshot s;
  world.Save(s);
  const mjModel* m = world.model().get();
  mjData* d = mj_makeData(m);
  std::copy(s.qpos.begin(), s.qpos.end(), d->qpos);
  std::copy(s.mocap_pos.begin(), s.mocap_pos.end(), d->mocap_pos);
  std::copy(s.mocap_quat.begin(), s.mocap_quat.end(), d->mocap_quat);
  mj_forward(m, d);
  std::set<std::string> pairs;
  for (int i = 0; i < d->ncon; ++i) {
    const auto name = [&](int g) {
      const char* n = mj_id2name(m, mjOBJ_GEOM, g);
      return n != nullptr ? std::string(n) : "geom " + std::to_string(g);
    };
    pairs.insert(name(d->contact[i].geom1) + " - " + name(d->contact[i].geom2));
  }
  mj_deleteData(d);
  return pairs;
}

std::string ErrorOf(const std::function<void()>& call) {
  try {
    call();
  } catch (const std::runtime_error& e) {
    return e.what();
  }
  return "";
}

TEST_CASE("What cannot be simulated is refused in one line, and nothing hangs") {
  World world(kModels, "pick_place");
  CHECK_THROWS_WITH(world.Reset(0, std::nan("")), Catch::Contains("spread"));
  CHECK_THROWS_WITH(world.Reset(0, -1), Catch::Contains("spread"));
  CHECK_THROWS_WITH(world.Reset(0, World::kMaxSpread + 1), Catch::Contains("spread"));
  world.Reset(0, 2);
  ServoTarget target;
  target.q = World::Home();
  target.q[1] = std::numeric_limits<double>::quiet_NaN();
  CHECK_THROWS_WITH(world.Step(target), Catch::Contains("not finite"));
  target.q[1] = 1e15;
  const auto run = [&] {
    for (int i = 0; i < 100; ++i) world.Step(target);
  };
  CHECK_THROWS_WITH(run(), Catch::Contains("broke down"));
  world.Reset(0, 2);  // and a reset makes it good again
  target.q = World::Home();
  CHECK_NOTHROW(world.Step(target));
}

}  // namespace

TEST_CASE("The same seed gives the same state after 10,000 steps, after other seeds and in a new world") {
  constexpr int kTicks = 5000;  // of two physics steps each
  World world(kModels, "pick_place");
  const uint64_t first = Swing(world, 7, kTicks);
  const uint64_t other = Swing(world, 8, kTicks);
  CHECK(Swing(world, 7, kTicks) == first);
  World fresh(kModels, "pick_place");
  CHECK(Swing(fresh, 7, kTicks) == first);
  CHECK(other != first);
}

TEST_CASE("At the start the arm rests at home, in touch with nothing, and stays there") {
  World world(kModels, "pick_place");
  for (int seed = 0; seed < 5; ++seed) {
    world.Reset(seed, 5);
    CHECK(world.time_us() == 0);
    CHECK(world.Arm().q == World::Home());
    CHECK(world.Arm().gripper_opening == Approx(2 * 0.0089));
    const Pose X_WG = ArmModel::Lite6().Tip(world.Arm().q);
    CHECK((X_WG.p - Eigen::Vector3d(0.22, 0, 0.20)).norm() < 1e-6);
    CHECK((X_WG.q * Eigen::Vector3d::UnitZ() + Eigen::Vector3d::UnitZ()).norm() < 1e-6);
    CHECK(PairsInContact(world) == std::set<std::string>{"table - block_cube"});
    const Pose before = world.Objects()[0].X_WO;
    for (int i = 0; i < 250; ++i) world.Step({World::Home(), JointVector::Zero(), false});
    CHECK(world.time_us() == 1'000'000);
    CHECK((world.Arm().q - World::Home()).cwiseAbs().maxCoeff() < 1e-5);
    CHECK(world.Arm().dq.cwiseAbs().maxCoeff() < 1e-4);
    CHECK(world.Arm().gripper_opening == Approx(2 * 0.0089).margin(2e-4));
    CHECK(PairsInContact(world) == std::set<std::string>{"table - block_cube"});
    const Eigen::Vector3d moved = world.Objects()[0].X_WO.p - before.p;
    CHECK(moved.head<2>().norm() < 1e-5);
    CHECK(std::abs(moved.z()) < 5e-4);  // contacts are springs
  }
}

TEST_CASE("Objects start uniformly in a disc about their nominal place, with yaw within its limit") {
  World world(kModels, "pick_place");
  const std::vector<TaskObject> objects = world.task().objects();
  REQUIRE(objects.size() == 2);
  const double spread_cm = GENERATE(0.0, 2.0, 5.0, 12.0);
  const double disc = 0.01 * spread_cm, yaw_limit = std::min(3 * spread_cm, 30.0) * kDegree;
  CAPTURE(spread_cm);
  constexpr int kResets = 1000;
  for (size_t i = 0; i < objects.size(); ++i) {
    const TaskObject& o = objects[i];
    const Eigen::Vector3d nominal(o.radius * std::cos(o.azimuth), o.radius * std::sin(o.azimuth), o.height);
    double radius = 0, yaw = 0;
    Eigen::Vector2d offset = Eigen::Vector2d::Zero();
    for (int seed = 0; seed < kResets; ++seed) {
      world.Reset(seed, spread_cm);
      const TrackedObject object = world.Objects()[i];
      REQUIRE(object.id == o.id);
      const Eigen::Vector3d d = object.X_WO.p - nominal;
      const double turn = WrappedAngle(Yaw(object.X_WO) - o.azimuth);
      REQUIRE(std::abs(d.z()) < 1e-9);
      REQUIRE(d.norm() <= disc + 1e-9);
      REQUIRE(std::abs(turn) <= yaw_limit + 1e-9);
      radius += d.norm() / kResets;
      yaw += std::abs(turn) / kResets;
      offset += d.head<2>() / kResets;
    }
    // Further apart than in 2 cm the objects come into each other's way, and their places are not uniform any
    // more.
    if (spread_cm == 2) {
      // Four standard errors: a radius spreads by .24 of the disc's, a coordinate by .5, |yaw| by .29 of its
      // limit.
      CHECK(radius == Approx(disc * 2 / 3).margin(disc * 4 * 0.24 / std::sqrt(kResets)));
      CHECK(offset.cwiseAbs().maxCoeff() < disc * 4 * 0.5 / std::sqrt(kResets));
    }
    CHECK(yaw == Approx(yaw_limit / 2).margin(yaw_limit * 4 * 0.29 / std::sqrt(kResets) + 1e-9));
  }
}

TEST_CASE("The block is taken by its handle, lifted and held without creeping") {
  World world(kModels, "pick_place");
  world.Reset(3, 2);
  CHECK(world.Subgoals() == 0);
  test::ScriptedArm arm(world);
  arm.PickBlock(0.10);
  arm.Hold(0.5);
  CHECK(world.Objects()[0].X_WO.p.z() == Approx(0.122).margin(0.002));
  CHECK(world.SubgoalNames() == std::vector<std::string>{"grasped", "lifted", "placed"});
  CHECK(world.Subgoals() == 0b011);
  CHECK(world.FailureReason() == "block not released");
  const Pose before = arm.X_WG().Inverse() * world.Objects()[0].X_WO;
  arm.Hold(5);
  const Pose after = arm.X_WG().Inverse() * world.Objects()[0].X_WO;
  const double creep = (after.p - before.p).norm();
  std::cout << "creep in 5 s: " << 1e3 * creep << " mm, " << AngleBetween(before.q, after.q) / kDegree
            << " deg\n";
  CHECK(creep < 0.0005);
  CHECK(AngleBetween(before.q, after.q) < 0.5 * kDegree);
  CHECK(world.Subgoals() == 0b011);
}

TEST_CASE("A block that stands released on the goal is a success") {
  World world(kModels, "pick_place");
  const int seed = GENERATE(0, 1, 2);
  world.Reset(seed, 2);
  CHECK_FALSE(world.Success());
  CHECK(world.FailureReason() == "block over 2 cm from the goal");
  test::ScriptedArm arm(world);
  arm.PickBlock(0.10);
  CHECK_FALSE(world.Success());

  Pose on_goal = world.Objects()[1].X_WO;
  on_goal.p.z() += 0.022;
  const Pose place = arm.Grasp(on_goal);
  arm.MoveTo(arm.Above(place, 0.06), 1.5);
  arm.MoveTo(arm.Above(place, 0.001), 1.0);
  CHECK(world.FailureReason() == "block not released");
  arm.Open();
  arm.MoveTo(arm.Above(place, 0.08), 1.0);
  CHECK(world.FailureReason() == "");
  CHECK(world.Success());
  CHECK(world.Subgoals() == 0b100);

  // One that is put elsewhere afterwards is none.
  world.Reset(seed, 2);
  CHECK_FALSE(world.Success());
}

TEST_CASE("A block put down beside the goal is none, and the reason says so") {
  World world(kModels, "pick_place");
  test::ScriptedArm arm(world);
  arm.PickBlock(0.06);
  const double beside = GENERATE(0.018, 0.022, 0.05);  // [m]
  Pose X_WO = world.Objects()[1].X_WO;
  X_WO.p += Eigen::Vector3d(-beside, 0, 0.022);
  const Pose place = arm.Grasp(X_WO);
  arm.MoveTo(arm.Above(place, 0.06), 1.5);
  arm.MoveTo(arm.Above(place, 0.001), 1.0);
  arm.Open();
  arm.MoveTo(arm.Above(place, 0.08), 1.0);
  CAPTURE(beside);
  CHECK(world.Success() == (beside < 0.02));
  CHECK(world.FailureReason() == (beside < 0.02 ? "" : "block over 2 cm from the goal"));
}

TEST_CASE("A block that hangs, falls or lies over the goal is no success") {
  World world(kModels, "pick_place");
  test::ScriptedArm arm(world);
  arm.PickBlock(0.08);
  Pose X_WO = world.Objects()[1].X_WO;
  X_WO.p += Eigen::Vector3d(0, 0, 0.022 + 0.06);
  const Pose over = arm.Grasp(X_WO);
  arm.MoveTo(over, 1.5);
  CHECK(world.FailureReason() == "block not released");
  SECTION("let go in the air") {
    const ServoTarget open{world.Arm().q, JointVector::Zero(), false};
    for (int i = 0; i < 50 && world.FailureReason() == "block not released"; ++i) world.Step(open);
    CHECK(world.FailureReason() == "block does not stand on the table");
  }
  SECTION("laid on its side") {
    // Tilted by 50 degrees about the handle's thin axis, an edge on the table, it falls over when let go.
    Pose tilted = over;
    tilted.q = over.q * ExpSO3({0, 50 * kDegree, 0});
    tilted.p.z() = 0.075;
    arm.MoveTo(tilted, 1.5);
    arm.Open();
    arm.MoveTo(arm.Above(tilted, 0.08), 1.0);
    CHECK(world.FailureReason() == "block fell over");
  }
}

TEST_CASE("An unknown task is refused in one line that lists those known") {
  const std::string error = ErrorOf([] { World world(kModels, "juggle"); });
  CHECK(error ==
        "unknown task \"juggle\"; known: pick_place, drawer_open, box_open, pour, stir, drawer_open+pick_place, "
        "pour+stir, box_open+pour");
  CHECK_THROWS_WITH(World(kModels, "stir+juggle"), Catch::Contains("unknown task \"stir+juggle\""));
}

TEST_CASE("A missing or broken scene is refused in one line that names the file") {
  const std::string folder =
      std::filesystem::temp_directory_path() / ("intabs_scene_" + std::to_string(getpid()));
  const std::string file = folder + "/scenes/pick_place.xml";
  std::filesystem::create_directories(folder + "/scenes");
  std::filesystem::create_directory_symlink(kModels + "/lite6", folder + "/lite6");
  const auto error_with = [&](const std::string& xml) {
    std::ofstream(file) << xml;
    return ErrorOf([&] { World world(folder, "pick_place"); });
  };
  const std::string arm = "<include file='../lite6/lite6.xml'/>";
  const std::string goal = "<body name='goal' mocap='true'/>";
  for (const std::string& error :
       {error_with("hello"), error_with("<mujoco><worldbody>"),
        error_with("<mujoco><include file='none.xml'/></mujoco>"),
        error_with("<mujoco><worldbody><geom size='a'/></worldbody></mujoco>"), error_with("<mujoco/>"),
        error_with("<mujoco>" + arm + "</mujoco>"),
        error_with("<mujoco>" + arm + "<worldbody><body name='block'/>" + goal + "</worldbody></mujoco>")}) {
    CAPTURE(error);
    CHECK_THAT(error, Catch::Contains(file));
    CHECK(error.find('\n') == std::string::npos);
  }
  CHECK_THAT(error_with("<mujoco>" + arm + "</mujoco>"), Catch::Contains("has no body \"block\""));
  std::filesystem::remove_all(folder);
  const std::string error = ErrorOf([&] { World world(folder, "pick_place"); });
  CHECK_THAT(error, Catch::Contains(file));
  CHECK(error.find('\n') == std::string::npos);
}

}  // namespace intabs
