#include "intabs/sim/arm_sim.h"

#include <catch2/catch.hpp>
#include <random>
#include <vector>

namespace intabs {
namespace {

const std::string kModels = INTABS_SOURCE_DIR "/models";

// Two seconds of commands at 25 Hz with a gap in which the arm goes stale. Returns the state's hash at every
// policy tick.
std::vector<uint64_t> Play(ArmSim& sim, int64_t seed) {
  std::mt19937 random(11);
  std::uniform_real_distribution<double> u(-0.2, 0.2);
  sim.Reset(seed, 3);
  std::vector<uint64_t> hashes;
  ArmCommand c;
  c.session = 5;
  c.mode = ArmMode::kServo;
  c.q_target = World::Home();
  for (int tick = 0; tick < 50; ++tick) {
    for (double& q : c.q_target) q += u(random);
    ++c.seq;
    c.gripper_closed = tick > 25;
    if (tick < 20 || tick > 30) (void)sim.Accept(c);
    for (int i = 0; i < 10; ++i) sim.Tick();
    PlantTruth truth;
    sim.Truth(truth);
    hashes.push_back(truth.state_hash);
  }
  return hashes;
}

}  // namespace

TEST_CASE(
    "The same seed and commands give the same states, in a new plant and after other runs in this one") {
  ArmSim sim(kModels, "pick_place");
  const auto first = Play(sim, 1);
  const auto other = Play(sim, 2);
  const auto again = Play(sim, 1);
  ArmSim fresh(kModels, "pick_place");
  CHECK(again == first);
  CHECK(Play(fresh, 1) == first);
  CHECK(other.back() != first.back());
}

TEST_CASE("The arm follows what its filter says") {
  ArmSim sim(kModels, "pick_place");
  ArmStatus status;
  sim.Status(status);
  CHECK(status.seq == 1);
  CHECK(status.utime == 0);
  CHECK(status.state == ArmState::kIdle);
  CHECK((status.q_commanded - status.q).norm() < 1e-9);

  ArmCommand c;
  c.session = 5;
  c.mode = ArmMode::kServo;
  c.q_target = status.q;
  c.q_target[0] += 0.5;
  c.gripper_closed = true;
  c.lifetime_us = 5000000;
  REQUIRE(sim.Accept(c) == Refusal::kAccepted);
  double worst = 0;
  for (int i = 0; i < 375; ++i) {
    sim.Tick();
    sim.Status(status);
    worst = std::max(worst, (status.q - status.q_commanded).cwiseAbs().maxCoeff());
  }
  CHECK(worst < 0.01);
  CHECK(status.q_commanded == c.q_target);
  CHECK((status.q - c.q_target).cwiseAbs().maxCoeff() < 1e-3);
  CHECK(status.dq.cwiseAbs().maxCoeff() < 1e-3);
  CHECK(status.gripper_closed);
  CHECK(status.gripper_opening < 0.001);
  CHECK(status.utime == 1500000);
  CHECK(status.seq == 376);
  sim.Reset(0, 0);
  sim.Status(status);
  CHECK(status.seq == 1);
  CHECK(status.utime == 0);
  CHECK(status.state == ArmState::kIdle);
  CHECK(status.session == 0);
}

TEST_CASE("Where a wall clock rules, commands age by it") {
  ArmSim sim(kModels, "pick_place");
  const int64_t start = 7'000'000'000;
  sim.Reset(0, 0, start);
  ArmStatus status;
  ArmCommand c;
  c.session = 5;
  c.mode = ArmMode::kServo;
  c.q_target = World::Home();
  REQUIRE(sim.Accept(c, start) == Refusal::kAccepted);
  sim.Tick(start + 4000);
  sim.Status(status);
  CHECK(status.state == ArmState::kTracking);
  sim.Tick(start + 304000);  // the process stood still for 300 ms
  sim.Status(status);
  CHECK(status.state != ArmState::kTracking);
}

TEST_CASE("The truth names the objects of the task") {
  ArmSim sim(kModels, "pick_place");
  sim.Reset(4, 2);
  PlantTruth truth;
  sim.Truth(truth);
  CHECK(truth.objects[0].id == 0);
  CHECK(truth.objects[1].id == 1);
  CHECK(truth.objects[2].id == -1);
  CHECK(truth.objects[0].valid);
  CHECK_FALSE(truth.success);
  CHECK_THROWS_WITH(ArmSim(kModels, "no_such_task"),
                    Catch::Contains("no_such_task") && Catch::Contains("pick_place"));
}

}  // namespace intabs
