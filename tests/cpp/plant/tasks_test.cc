// That each task can be done with the gripper there is, and that its success is measured on the state.
#include <catch2/catch.hpp>
#include <chrono>
#include <ctime>
#include <iostream>
#include <map>

#include "intabs/plant/task.h"
#include "plant/scripted_tasks.h"

namespace intabs {
namespace {

const std::string kModels = INTABS_SOURCE_DIR "/models";
constexpr double kDegree = M_PI / 180;
using Names = std::vector<std::string>;

// Simulated seconds a second of CPU, the scripts' inverse kinematics (a tenth) included.
struct Speed {
  explicit Speed(const World& w, const std::string& n) : world(w), name(n) {}
  ~Speed() {
    const double cpu = static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC;
    std::cout << name << ": " << 1e-6 * static_cast<double>(world.time_us()) / cpu << " x real time\n";
  }
  const World& world;
  const std::string name;
  const std::clock_t start = std::clock();
};

uint64_t Swing(std::vector<World*> worlds, int64_t seed, int ticks) {
  for (World* w : worlds) w->Reset(seed, 3);
  ServoTarget target;
  for (int i = 0; i < ticks; ++i) {
    const double t = 0.004 * i;
    for (int k = 0; k < kNumJoints; ++k) {
      const double amplitude = 0.25, w = 1 + 0.3 * k;
      target.q[k] = World::Home()[k] + amplitude * std::sin(w * t);
      target.dq[k] = amplitude * w * std::cos(w * t);
    }
    target.gripper_closed = std::fmod(t, 2) > 1;
    for (World* w : worlds) w->Step(target);
  }
  return worlds.back()->StateHash();
}

}  // namespace

TEST_CASE("Slots and ids mean the same in tasks and compositions") {
  const std::map<std::string, std::array<int, kMaxObjects>> wanted = {
      {"pick_place", {0, 1, -1, -1}},
      {"drawer_open", {-1, -1, -1, 2}},
      {"box_open", {-1, -1, -1, 3}},
      {"pour", {4, 5, -1, -1}},
      {"stir", {-1, 5, 6, -1}},
      {"drawer_open+pick_place", {0, 1, -1, 2}},
      {"pour+stir", {4, 5, 6, -1}},
      {"box_open+pour", {4, 5, -1, 3}},
  };
  REQUIRE(TaskNames().size() == wanted.size());
  for (const std::string& name : TaskNames()) {
    CAPTURE(name);
    World world(kModels, name);
    for (int seed = 0; seed < 3; ++seed) {
      world.Reset(seed, 5);
      for (int slot = 0; slot < kMaxObjects; ++slot) {
        CHECK(world.Objects()[slot].id == wanted.at(name)[slot]);
        CHECK(world.Objects()[slot].valid == (world.Objects()[slot].id >= 0));
      }
      CHECK_FALSE(world.Success());
      CHECK(world.Subgoals() == 0);
      CHECK(world.SubgoalNames().size() > 1);
    }
  }
}

TEST_CASE("Furniture stands where the seed says, its parts and what hangs on it too, and the hash knows it") {
  World world(kModels, GENERATE("drawer_open", "box_open", "stir"));
  const TaskObject o = world.task().objects().back();  // carried by furniture
  REQUIRE_FALSE(o.base.empty());
  world.Reset(0, 0);
  const Pose nominal{{o.radius * std::cos(o.azimuth), o.radius * std::sin(o.azimuth), 0},
                     ExpSO3({0, 0, o.azimuth + o.turn})};
  const Pose X_base = nominal.Inverse() * world.Objects()[o.slot].X_WO;
  double moved = 0, turned = 0;
  for (int seed = 0; seed < 20; ++seed) {
    world.Reset(seed, 5);
    const uint64_t hash = world.StateHash();
    const Pose X_WB = world.Objects()[o.slot].X_WO * X_base.Inverse();
    moved = std::max(moved, (X_WB.p - nominal.p).norm());
    turned = std::max(turned, AngleBetween(X_WB.q, nominal.q));
    CHECK(std::abs(X_WB.p.z()) < 5e-4);  // contacts are springs
    world.Reset(seed + 1, 5);
    CHECK(world.StateHash() != hash);
    world.Reset(seed, 5);
    CHECK(world.StateHash() == hash);
  }
  CHECK(moved > 0.03);
  CHECK(moved <= 0.051);
  CHECK(turned > 8 * kDegree);
  CHECK(turned <= 15.1 * kDegree);
}

TEST_CASE("Beads lie still in their vessel from the start") {
  const auto [name, slot] = GENERATE(table<std::string, int>({{"pour", 0}, {"stir", 1}, {"pour+stir", 0}}));
  World world(kModels, name);
  for (int seed = 0; seed < 3; ++seed) {
    world.Reset(seed, 5);
    CHECK(world.Touches().beads == 30);
    CHECK(world.Touches().beads_in[slot] == 30);
    CHECK(world.Arm().q == World::Home());
    Snapshot before, after;
    world.Save(before);
    for (int i = 0; i < 125; ++i) world.Step({World::Home(), JointVector::Zero(), false});
    world.Save(after);
    double moved = 0;
    for (size_t i = 0; i < before.qpos.size(); ++i) moved = std::max(moved, std::abs(after.qpos[i] - before.qpos[i]));
    CHECK(moved < 0.003);
    CHECK(world.Touches().beads_in[slot] == 30);
  }
}

TEST_CASE("The same seed gives the same state after 10,000 steps, alone, after other seeds and in a batch") {
  const std::string name = GENERATE("drawer_open+pick_place", "box_open", "pour+stir");
  constexpr int kTicks = 5000;  // of two physics steps each
  World alone(kModels, name), other(kModels, name), third(kModels, "drawer_open");
  const uint64_t first = Swing({&alone}, 7, kTicks);
  CHECK(Swing({&alone}, 8, 100) != first);
  CHECK(Swing({&third, &other, &alone}, 7, kTicks) == first);
  CHECK(other.StateHash() == first);
}

TEST_CASE("A drawer pulled out by its bar over 8 cm is a success, and who touches whom is told") {
  World world(kModels, "drawer_open");
  const int seed = GENERATE(0, 1, 2);
  world.Reset(seed, 5);
  CHECK(world.FailureReason() == "drawer pulled out under 8 cm");
  CHECK(world.Touches().touches[3] == 0);
  const Pose before = world.Objects()[3].X_WO;
  test::ScriptedArm arm(world);
  const double distance = GENERATE(0.06, 0.10);
  {
    const Speed speed(world, "drawer_open");
    test::PullDrawer(world, arm, distance);
  }
  CHECK((world.Objects()[3].X_WO.p - before.p).norm() == Approx(distance).margin(0.005));
  CHECK(world.Success() == (distance > 0.08));
  CHECK(world.Subgoals() == (distance > 0.08 ? 0b10 : 0));
  arm.MoveTo({world.Objects()[3].X_WO.p, arm.X_WG().q}, 1);
  arm.Close();
  CHECK(world.Touches().touches[3] == (kTouchesLeftFinger | kTouchesRightFinger));
  CHECK((world.Subgoals() & 1) == 1);
}

TEST_CASE("A lid pushed over 60 degrees stays open and is a success") {
  World world(kModels, "box_open");
  const int seed = GENERATE(0, 1, 2);
  world.Reset(seed, 5);
  CHECK(world.FailureReason() == "lid open less than 60 degrees");
  const double angle = GENERATE(45., 80.) * kDegree;
  test::ScriptedArm arm(world);
  {
    const Speed speed(world, "box_open");
    test::PushLid(world, arm, angle);
  }
  CHECK(world.Success() == (angle > 60 * kDegree));
  CHECK(world.Subgoals() == (angle > 60 * kDegree ? 0b110 : 0b010));
  const Pose lid = world.Objects()[3].X_WO;
  arm.Hold(2);
  CHECK(AngleBetween(world.Objects()[3].X_WO.q, lid.q) < 0.5 * kDegree);
}

TEST_CASE("Beads poured from the cup into the bowl are a success once the cup is upright again") {
  World world(kModels, "pour");
  world.Reset(GENERATE(1, 2, 3), 4);
  CHECK(world.FailureReason() == "under 80 % of the beads in the bowl");
  test::ScriptedArm arm(world);
  const Speed speed(world, "pour");
  const Pose X_GC = test::LiftCup(world, arm);
  CHECK(world.Subgoals() == 0b0011);
  CHECK(world.Touches().beads_in[0] == 30);
  CHECK(world.Touches().touches[0] == (kTouchesLeftFinger | kTouchesRightFinger));
  test::Pour(world, arm, X_GC, 0.5);
  CHECK(world.Touches().beads_in[1] >= 24);
  CHECK(world.FailureReason() == "cup not upright");
  test::PutCup(arm, X_GC, {0.38, -0.12, 0});
  CHECK(world.FailureReason() == "");
  CHECK(world.Subgoals() == 0b1100);
  CHECK(world.Touches().touches[0] == kTouchesScene);
}

TEST_CASE("Two turns of the spoon among the beads are a success, fewer are not") {
  World world(kModels, "stir");
  world.Reset(GENERATE(1, 2), 5);
  CHECK(world.FailureReason() == "spoon turned less than twice in the bowl");
  CHECK(world.Touches().touches[2] == kTouchesScene);
  const double turns = GENERATE(1.7, 2.3);
  test::ScriptedArm arm(world);
  {
    const Speed speed(world, "stir");
    test::Stir(world, arm, turns);
  }
  CHECK(world.FailureReason() == (turns > 2 ? "" : "spoon turned less than twice in the bowl"));
  CHECK(world.Subgoals() == (turns > 2 ? 0b101 : 0b001));
  CHECK(world.Touches().beads_in[1] >= 24);
  world.Reset(1, 5);
  CHECK_FALSE(world.Success());  // what was remembered is forgotten
}

TEST_CASE("A composition is done when all its parts are, and its sub-goals are theirs") {
  SECTION("a drawer, then a block") {
    World world(kModels, "drawer_open+pick_place");
    world.Reset(2, 3);
    CHECK(world.SubgoalNames() == Names{"bar grasped", "drawer open", "grasped", "lifted", "placed"});
    test::ScriptedArm arm(world);
    test::PullDrawer(world, arm, 0.10);
    CHECK(world.FailureReason() == "block over 2 cm from the goal");
    CHECK(world.Subgoals() == 0b00010);
    arm.PickBlock(0.10);
    Pose on_goal = world.Objects()[1].X_WO;
    on_goal.p.z() += 0.022;
    const Pose place = arm.Grasp(on_goal);
    arm.MoveTo(arm.Above(place, 0.06), 1.5);
    arm.MoveTo(arm.Above(place, 0.001), 1.0);
    arm.Open();
    arm.MoveTo(arm.Above(place, 0.08), 1.0);
    CHECK(world.FailureReason() == "");
    CHECK(world.Subgoals() == 0b10010);
  }
  SECTION("a box, then a cup") {
    World world(kModels, "box_open+pour");
    world.Reset(2, 3);
    test::ScriptedArm arm(world);
    test::PushLid(world, arm, 80 * kDegree);
    CHECK(world.FailureReason() == "under 80 % of the beads in the bowl");
    arm.Open();
    test::Pour(world, arm, test::LiftCup(world, arm));
    CHECK(world.FailureReason() == "");
  }
  SECTION("a cup, then a spoon") {
    World world(kModels, "pour+stir");
    world.Reset(2, 3);
    test::ScriptedArm arm(world);
    const Pose X_GC = test::LiftCup(world, arm);
    test::Pour(world, arm, X_GC);
    CHECK(world.FailureReason() == "spoon turned less than twice in the bowl");
    test::PutCup(arm, X_GC, {0.37, -0.15, 0});
    test::Stir(world, arm, 2.3);
    CHECK(world.FailureReason() == "");
  }
}

TEST_CASE("Beads beside the bowl and a vessel that fell over are failures with a name") {
  World world(kModels, "pour");
  world.Reset(1, 0);
  test::ScriptedArm arm(world);
  (void)test::LiftCup(world, arm);
  const Pose up = arm.X_WG();
  // Rolled by joint 6 alone, over the table.
  for (int i = 1; i <= 500; ++i) {
    arm.Follow({up.p, up.q * ExpSO3({0, 0, 150 * kDegree * i / 500})});
  }
  arm.Hold(0.5);
  CHECK(world.Touches().beads_in[0] < 24);
  CHECK(world.FailureReason() == "under 80 % of the beads in the bowl");
}

}  // namespace intabs
