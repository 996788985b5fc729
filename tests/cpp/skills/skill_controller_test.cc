#include "intabs/skills/skill_controller.h"

#include <catch2/catch.hpp>
#include <limits>
#include <vector>

#include "common/alloc_hook.h"
#include "policy_weights.h"

namespace intabs {
namespace {

constexpr int64_t kSession = 77;

SkillController MakeController() {
  return SkillController(Policy::FromWeights(RandomPolicyWeights(), ArmModel::Lite6()), kSession);
}

std::vector<Skill> Plan(std::initializer_list<int> ticks) {
  std::vector<Skill> plan;
  for (const int n : ticks) {
    Skill s;
    s.z.setConstant(0.1f * static_cast<float>(plan.size() + 1));
    s.min_ticks = s.max_ticks = n;
    plan.push_back(s);
  }
  return plan;
}

struct Readings {
  ArmStatus status;
  ObjectPoses poses;
  Readings() {
    status.q << 0, 0.3, 1.2, 0, 0.9, 0;
    status.q_commanded = status.q;
    status.state = ArmState::kHolding;
    poses.objects[0].id = 0;
    poses.objects[0].valid = true;
    poses.objects[0].X_WO.p << 0.28, -0.07, 0.02;
    Advance();
  }
  void Advance() {
    status.utime += kPolicyPeriodUs;
    ++status.seq;
    poses.exposure_utime = status.utime;
  }
};

TEST_CASE("A plan plays each skill for its ticks, integrates steps, and then asks to hold") {
  SkillController controller = MakeController();
  Readings r;
  ArmCommand command;
  CHECK(controller.Tick(r.status, r.poses, command) == Status::kNotReady);
  CHECK(command.mode == ArmMode::kHold);

  REQUIRE(controller.Start(5, Plan({3, 2})) == Status::kOk);
  JointVector last = r.status.q_commanded;
  for (int i = 0; i < 5; ++i) {
    CHECK(controller.player().status().skill_index == (i < 3 ? 0 : 1));
    r.Advance();
    REQUIRE(controller.Tick(r.status, r.poses, command) == Status::kOk);
    CHECK(command.mode == ArmMode::kServo);
    CHECK(command.session == kSession);
    CHECK(command.status_seq == r.status.seq);
    // One step of the network away from the last target: not from the measured pose.
    CHECK((command.q_target - last).cwiseAbs().maxCoeff() > 0);
    CHECK((command.q_target - last).cwiseAbs().maxCoeff() < 0.1);
    last = command.q_target;
  }
  CHECK(controller.player().status().end_reason == EndReason::kFinished);
  r.Advance();
  CHECK(controller.Tick(r.status, r.poses, command) == Status::kFinished);
  CHECK(command.mode == ArmMode::kHold);
}

TEST_CASE("Each skill starts from a fresh hidden state, so the same skill twice does the same from the same state") {
  SkillController controller = MakeController();
  Readings r;
  std::vector<Skill> plan = Plan({2, 2});
  plan[1].z = plan[0].z;
  REQUIRE(controller.Start(1, plan) == Status::kOk);
  std::vector<JointVector> target;
  ArmCommand command;
  for (int i = 0; i < 4; ++i) {
    r.Advance();
    REQUIRE(controller.Tick(r.status, r.poses, command) == Status::kOk);
    target.push_back(command.q_target);
  }
  const JointVector first = target[0] - r.status.q_commanded;
  CHECK(((target[2] - target[1]) - first).norm() < 1e-9);
  CHECK(((target[1] - target[0]) - first).norm() > 1e-9);  // within a skill the state is carried
}

TEST_CASE("Old poses, a driver that left, and readings that are not finite end the plan with their reason") {
  SkillController controller = MakeController();
  Readings r;
  ArmCommand command;
  REQUIRE(controller.Start(1, Plan({50})) == Status::kOk);
  SECTION("old poses") {
    r.poses.exposure_utime = r.status.utime - kPosesGoneUs - 1;
    CHECK(controller.Tick(r.status, r.poses, command) == Status::kNotReady);
    CHECK(controller.player().status().end_reason == EndReason::kStalePoses);
  }
  SECTION("fault") {
    r.status.state = ArmState::kFault;
    CHECK(controller.Tick(r.status, r.poses, command) == Status::kNotReady);
    CHECK(controller.player().status().end_reason == EndReason::kRefused);
  }
  SECTION("another session") {
    r.status.state = ArmState::kTracking;
    r.status.session = kSession + 1;
    CHECK(controller.Tick(r.status, r.poses, command) == Status::kNotReady);
    CHECK(controller.player().status().end_reason == EndReason::kRefused);
  }
  SECTION("not finite") {
    r.status.q[2] = std::numeric_limits<double>::quiet_NaN();
    CHECK(controller.Tick(r.status, r.poses, command) == Status::kInvalidInput);
    CHECK(controller.player().status().end_reason == EndReason::kBadInput);
  }
  CHECK(command.mode == ArmMode::kHold);
}

TEST_CASE("While poses are old the plan waits and the arm is asked to hold; with new ones it goes on where it was") {
  SkillController controller = MakeController(), undisturbed = MakeController();
  Readings r;
  ArmCommand command, expected;
  REQUIRE(controller.Start(1, Plan({3})) == Status::kOk);
  REQUIRE(undisturbed.Start(1, Plan({3})) == Status::kOk);
  for (int tick = 0; tick < 3; ++tick) {
    r.Advance();
    const int64_t seen = r.status.utime;
    for (const int64_t age : {kMaxPoseAgeUs + 1, kPosesGoneUs}) {
      r.poses.exposure_utime = seen - age;
      CHECK(controller.Tick(r.status, r.poses, command) == Status::kNotReady);
      CHECK(command.mode == ArmMode::kHold);
      CHECK(controller.player().status().end_reason == EndReason::kRunning);
    }
    r.poses.exposure_utime = seen - kMaxPoseAgeUs;
    CHECK(controller.Tick(r.status, r.poses, command) == Status::kOk);
    CHECK(undisturbed.Tick(r.status, r.poses, expected) == Status::kOk);
    CHECK(command.mode == ArmMode::kServo);
    CHECK(command.q_target == expected.q_target);
  }
  CHECK(controller.player().status().end_reason == EndReason::kFinished);
}

TEST_CASE("Plans that cannot be played are refused") {
  SkillController controller = MakeController();
  CHECK(controller.Start(1, {}) == Status::kOutOfRange);
  CHECK(controller.Start(1, Plan({0})) == Status::kOutOfRange);
  CHECK(controller.Start(1, Plan({kMaxSkillTicks + 1})) == Status::kOutOfRange);
  CHECK(controller.Start(1, std::vector<Skill>(kMaxSkills + 1, Plan({1})[0])) == Status::kOutOfRange);
  std::vector<Skill> plan = Plan({1});
  plan[0].z[4] = std::numeric_limits<float>::infinity();
  CHECK(controller.Start(1, plan) == Status::kOutOfRange);
}

TEST_CASE("Weights that do not fit this program are refused by name") {
  const ArmModel arm = ArmModel::Lite6();
  CHECK_THROWS_WITH(Policy::FromWeights(RandomPolicyWeights(60), arm), Catch::Contains("60 inputs"));
  CHECK_THROWS_WITH(Policy::FromWeights(RandomPolicyWeights(kPolicyInputDim, "other/1"), arm),
                    Catch::Contains("other/1"));
  CHECK_THROWS_WITH(Policy::FromWeights(RandomPolicyWeights(kPolicyInputDim, kStateLayout, 20000), arm),
                    Catch::Contains("20000"));
}

TEST_CASE("The policy tick does not allocate") {
  if (!AllocationHookActive()) {
    WARN("skipped: sanitizers own the allocator");
    return;
  }
  REQUIRE(AllocationHookSeesAll());  // positive control
  SkillController controller = MakeController();
  Readings r;
  ArmCommand command;
  REQUIRE(controller.Start(1, Plan({40, 40, 40})) == Status::kOk);
  int played = 0;
  const AllocationCounter counter;
  for (int i = 0; i < 200; ++i) {
    r.Advance();
    played += controller.Tick(r.status, r.poses, command) == Status::kOk;
    if (i == 130) (void)controller.Start(2, std::span<const Skill>());
  }
  const auto n = counter.count();
  CHECK(n == 0);
  CHECK(played == 120);
}

}  // namespace
}  // namespace intabs
