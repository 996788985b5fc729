#include "intabs/skills/skill_controller.h"

#include <algorithm>
#include <catch2/catch.hpp>
#include <limits>
#include <set>
#include <vector>

#include "common/alloc_hook.h"
#include "policy_weights.h"

namespace intabs {
namespace {

constexpr int64_t kSession = 77;

SkillController MakeController(float eta_logit = 0, std::shared_ptr<const SkillLibrary> library = nullptr) {
  const WeightsFile weights = RandomPolicyWeights(kPolicyInputDim, kStateLayout, kPolicyPeriodUs, eta_logit);
  SkillPlayer player(Policy::FromWeights(weights, ArmModel::Lite6()), Termination(weights), std::move(library));
  return SkillController(std::move(player), kSession);
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
    r.Advance();
    REQUIRE(controller.Tick(r.status, r.poses, command) == Status::kOk);
    CHECK(controller.player().status().skill_index == (i < 3 ? 0 : 1));
    CHECK(controller.player().status().skill_end == (i < 3 ? SkillEnd::kNone : SkillEnd::kLongest));
    CHECK(command.mode == ArmMode::kServo);
    CHECK(command.session == kSession);
    CHECK(command.status_seq == r.status.seq);
    // One step of the network away from the last target: not from the measured pose.
    CHECK((command.q_target - last).cwiseAbs().maxCoeff() > 0);
    CHECK((command.q_target - last).cwiseAbs().maxCoeff() < 0.1);
    last = command.q_target;
  }
  r.Advance();
  CHECK(controller.Tick(r.status, r.poses, command) == Status::kFinished);
  CHECK(controller.player().status().end_reason == EndReason::kFinished);
  CHECK(command.mode == ArmMode::kHold);
}

TEST_CASE("Targets stay within the joints' limits, where the driver takes them") {
  const ArmModel arm = ArmModel::Lite6();
  SkillController controller = MakeController();
  Readings r;
  for (const bool upper : {true, false}) {
    r.status.q_commanded = upper ? arm.q_max() : arm.q_min();
    controller.Abort(EndReason::kAborted);
    REQUIRE(controller.Start(upper ? 1 : 2, Plan({20})) == Status::kOk);
    JointVector lowest = arm.q_max(), highest = arm.q_min();
    for (int i = 0; i < 20; ++i) {
      r.Advance();
      ArmCommand command;
      REQUIRE(controller.Tick(r.status, r.poses, command) == Status::kOk);
      lowest = lowest.cwiseMin(command.q_target);
      highest = highest.cwiseMax(command.q_target);
    }
    CHECK((highest.array() <= arm.q_max().array()).all());
    CHECK((lowest.array() >= arm.q_min().array()).all());
    CHECK((lowest - highest).cwiseAbs().maxCoeff() > 0.01);  // pi moves some joints away from the limit
  }
}

TEST_CASE("eta ends a skill between its bounds") {
  for (const float logit : {10.f, -10.f}) {
    SkillController controller = MakeController(logit);
    Readings r;
    ArmCommand command;
    std::vector<Skill> plan = Plan({9, 9});
    for (Skill& s : plan) s.min_ticks = 4;
    REQUIRE(controller.Start(1, plan) == Status::kOk);
    int first = 0;
    while (controller.player().status().skill_index == 0) {
      r.Advance();
      REQUIRE(controller.Tick(r.status, r.poses, command) == Status::kOk);
      first += controller.player().status().skill_index == 0;
    }
    CHECK(first == (logit > 0 ? 4 : 9));
    CHECK(controller.player().status().skill_end == (logit > 0 ? SkillEnd::kTerminated : SkillEnd::kLongest));
    CHECK((controller.player().status().b > 0.5f) == false);  // at its first tick a skill cannot end
    r.Advance();
    REQUIRE(controller.Tick(r.status, r.poses, command) == Status::kOk);
    CHECK((controller.player().status().b > 0.5f) == (logit > 0));
  }
}

// Skills of 2 ticks: one that moves an object about, three that approach another, one that lifts it by 6 cm.
std::vector<Skill> PlanWithEffect() {
  std::vector<Skill> plan = Plan({2, 2, 2, 2, 2});
  plan[0].record.rested[1] = false;
  plan[4].record.rested[0] = false;
  plan[4].record.moved[0] = 0.06f;
  return plan;
}

TEST_CASE("A skill whose object stays where it was is tried again from the first that led up to it, and not for ever") {
  SkillController controller = MakeController();
  Readings r;
  ArmCommand command;
  REQUIRE(controller.Start(1, PlanWithEffect()) == Status::kOk);
  std::vector<int> played;
  while (controller.player().playing()) {
    r.Advance();
    if (controller.Tick(r.status, r.poses, command) == Status::kOk) played.push_back(controller.player().status().skill_index);
    REQUIRE(played.size() < 100);
  }
  std::vector<int> expected = {0, 0, 1, 1, 2, 2, 3, 3, 4, 4};
  for (int retry = 0; retry < kMaxRetries; ++retry) expected.insert(expected.end(), {1, 1, 2, 2, 3, 3, 4, 4});
  CHECK(played == expected);
  CHECK(controller.player().status().retries == kMaxRetries);
  CHECK(controller.player().status().end_reason == EndReason::kNoEffect);
  CHECK(command.mode == ArmMode::kHold);
}

TEST_CASE("What moves a second time in one grasp is tried again from before the grasp") {
  SkillController controller = MakeController();
  Readings r;
  ArmCommand command;
  std::vector<Skill> plan = PlanWithEffect();
  plan[2].record.closed = plan[3].record.closed = plan[4].record.closed = true;
  plan[3].record.rested[0] = false;  // pulled a little,
  plan[4].record.rested[0] = true;   // let rest, pulled on
  REQUIRE(controller.Start(1, plan) == Status::kOk);
  int least = 4;
  while (controller.player().playing()) {
    r.Advance();
    if (controller.Tick(r.status, r.poses, command) != Status::kOk) continue;
    if (controller.player().status().retries == 1) least = std::min(least, controller.player().status().skill_index);
  }
  CHECK(least == 1);
}

// Three demonstrations of a task: near, never done in practice, far; one of another task.
std::shared_ptr<SkillLibrary> FourDemonstrations(const Readings& r) {
  auto library = std::make_shared<SkillLibrary>();
  for (const int count : {5, 4, 3, 6}) {
    Chain chain;
    chain.first = static_cast<int>(library->skills.size());
    chain.count = count;
    chain.task = count == 6;
    chain.rate = count == 4 ? 0.f : 1.f;
    chain.q = r.status.q;
    chain.objects[0] = r.poses.objects[0];
    chain.objects[0].X_WO.p.x() += 0.01 * (5 - count);
    for (int i = 0; i < count; ++i) {
      Skill skill = Plan({2})[0];
      skill.chain = static_cast<int>(library->chains.size());
      if (i + 1 == count) skill.record.moved[0] = 0.06f;
      library->skills.push_back(skill);
    }
    library->chains.push_back(chain);
  }
  return library;
}

TEST_CASE("What fails twice is tried as another demonstration did it that does the task in practice") {
  Readings r;
  const auto library = FourDemonstrations(r);
  SkillController controller = MakeController(0, library);
  ArmCommand command;
  std::vector<Skill> plan(library->skills.begin(), library->skills.begin() + 5);
  plan.push_back(library->skills.back());  // of the other task: not all of its demonstration's
  const auto play = [&](int id, bool moves) {
    REQUIRE(controller.Start(id, plan) == Status::kOk);
    std::vector<int> skills;  // of the plan, at each retry
    int retries = 0;
    while (controller.player().playing()) {
      r.Advance();
      if (controller.Tick(r.status, r.poses, command) != Status::kOk) continue;
      const PlayerStatus& now = controller.player().status();
      if (now.retries > retries) skills.push_back(now.n_skills);
      retries = now.retries;
      if (moves && retries == 2) r.poses.objects[0].X_WO.p.z() += 0.02;
    }
    return skills;
  };
  CHECK(play(1, false) == std::vector<int>{6, 4, 4});  // five by the first, then three by the far one; nobody is left
  CHECK(controller.player().status().end_reason == EndReason::kNoEffect);
  CHECK(controller.player().status().skill_index == 2);
  CHECK(play(2, true) == std::vector<int>{6, 4});  // forgotten with the plan; what follows stays
  CHECK(controller.player().status().end_reason == EndReason::kFinished);
  CHECK(controller.player().status().skill_index == 3);

  controller.player().TryOthers(false);
  CHECK(play(3, false) == std::vector<int>{6, 6, 6});
  controller.player().TryOthers(true);
  plan.erase(plan.begin());  // not the demonstration as a whole: nobody asked for more
  CHECK(play(4, false) == std::vector<int>{5, 5, 5});
}

TEST_CASE("What the record had done before, with nothing else there, is demanded nearly whole") {
  const double came = GENERATE(0.05, 0.09);
  const bool done = GENERATE(true, false);
  SkillController controller = MakeController();
  Readings r;
  ArmCommand command;
  std::vector<Skill> plan = Plan({2, 2, 2});
  for (Skill& s : plan) s.record.rested[0] = false;
  plan[0].record.rested[0] = true;
  plan[1].record.moved[0] = plan[2].record.moved[0] = 0.1f;
  plan[2].record.alone = plan[2].record.done = done;
  REQUIRE(controller.Start(1, plan) == Status::kOk);
  while (controller.player().playing()) {
    r.Advance();
    (void)controller.Tick(r.status, r.poses, command);
    const PlayerStatus& now = controller.player().status();
    if (now.retries == 0 && now.skill_index == 1) r.poses.objects[0].X_WO.p.x() = 0.28 + came;
    if (now.retries == 1 && now.skill_index == 1) r.poses.objects[0].X_WO.p.x() = 0.28 + came + 0.045;
  }
  // The second time it comes 4.5 cm further of 10: what was there already counts.
  CHECK(controller.player().status().retries == (done && came < 0.075 ? 1 : 0));
  CHECK(controller.player().status().end_reason == EndReason::kFinished);
}

TEST_CASE("What came only as it was tried again is not to come twice, where it cannot lie anywhere else") {
  const bool alone = GENERATE(true, false);
  SkillController controller = MakeController();
  Readings r;
  ArmCommand command;
  std::vector<Skill> plan = PlanWithEffect();
  for (Skill& s : plan) s.record.alone = alone;
  REQUIRE(controller.Start(1, plan) == Status::kOk);
  while (controller.player().playing()) {
    r.Advance();
    (void)controller.Tick(r.status, r.poses, command);
    const PlayerStatus& now = controller.player().status();
    // As the arm draws back to begin anew; the object rests there from the next skill on.
    if (now.retries == 1 && now.skill_index == 1) r.poses.objects[0].X_WO.p.z() = 0.07;
  }
  CHECK(controller.player().status().retries == (alone ? 1 : kMaxRetries));
  CHECK(controller.player().status().end_reason == (alone ? EndReason::kFinished : EndReason::kNoEffect));
}

TEST_CASE("The demonstration that began most like now is the nearest") {
  Readings r;
  const auto library = FourDemonstrations(r);
  Observation now;
  now.q = r.status.q;
  now.objects = r.poses.objects;
  CHECK(library->Nearest(2, now, {0, 0, 0, 0}) == 0);
  now.objects[0].X_WO.p.x() += 0.015;
  CHECK(library->Nearest(0, now, {0, 0, 0, 0}) == 2);  // the second is nearer, but never did it
  CHECK(library->Nearest(0, now, {0, 0, 1, 0}) == 0);
  CHECK(library->Nearest(0, now, {1, 0, 1, 0}) == -1);
}

TEST_CASE("The shipped library holds its demonstrations whole") {
  const SkillLibrary library = SkillLibrary::Load(INTABS_SOURCE_DIR "/models/weights/lite6");
  REQUIRE(library.chains.size() >= 30);
  int next = 0, seen = 0;
  for (const Chain& chain : library.chains) {
    CHECK(chain.first == next);
    next += chain.count;
    CHECK((chain.rate >= 0 && chain.rate <= 1));
    for (const TrackedObject& object : chain.objects) seen += object.id >= 0;
  }
  CHECK(next == static_cast<int>(library.skills.size()));
  // Drawers and lids are alone in their worlds.
  std::set<int> alone;
  for (const Skill& skill : library.skills) {
    if (skill.record.done) alone.insert(library.chains[skill.chain].task);
  }
  CHECK(alone.size() == 2);
  CHECK(seen > static_cast<int>(library.chains.size()));
  CHECK_THROWS_WITH(SkillLibrary::Load("nowhere"), Catch::Contains("nowhere/skills.json"));
}

TEST_CASE("An effect that happens, even late, and one that cannot be seen are no reason to try again") {
  const bool seen = GENERATE(true, false);
  SkillController controller = MakeController();
  Readings r;
  ArmCommand command;
  REQUIRE(controller.Start(1, PlanWithEffect()) == Status::kOk);
  for (int tick = 0; tick < 11; ++tick) {
    r.Advance();
    if (!seen) r.poses.objects[0].valid = tick < 9;
    if (seen && tick == 9) r.poses.objects[0].X_WO.p.z() += 0.03;
    (void)controller.Tick(r.status, r.poses, command);
  }
  CHECK(controller.player().status().retries == 0);
  CHECK(controller.player().status().end_reason == EndReason::kFinished);
}

TEST_CASE("A pause holds the arm and keeps the plan; a new plan goes on from the target of the old one") {
  SkillController controller = MakeController();
  Readings r;
  ArmCommand command;
  REQUIRE(controller.Start(1, Plan({5})) == Status::kOk);
  r.Advance();
  REQUIRE(controller.Tick(r.status, r.poses, command) == Status::kOk);
  controller.Pause(true);
  r.Advance();
  CHECK(controller.Tick(r.status, r.poses, command) == Status::kNotReady);
  CHECK(command.mode == ArmMode::kHold);
  controller.Pause(false);
  for (int i = 0; i < 3; ++i) {
    r.Advance();
    REQUIRE(controller.Tick(r.status, r.poses, command) == Status::kOk);
  }
  const JointVector target = command.q_target;
  REQUIRE((target - r.status.q_commanded).norm() > 0);  // the filter is behind
  REQUIRE(controller.Start(2, Plan({5})) == Status::kOk);
  r.Advance();
  REQUIRE(controller.Tick(r.status, r.poses, command) == Status::kOk);
  SkillController fresh = MakeController();
  Readings beside;
  ArmCommand step;
  REQUIRE(fresh.Start(2, Plan({5})) == Status::kOk);
  beside.Advance();
  REQUIRE(fresh.Tick(beside.status, beside.poses, step) == Status::kOk);
  CHECK((command.q_target - target - (step.q_target - beside.status.q_commanded)).norm() < 1e-9);
}

TEST_CASE("A plan replaced before its first tick begins where the arm stands") {
  SkillController controller = MakeController();
  Readings r;
  ArmCommand command;
  REQUIRE(controller.Start(1, Plan({5})) == Status::kOk);
  REQUIRE(controller.Start(2, Plan({5})) == Status::kOk);
  r.Advance();
  REQUIRE(controller.Tick(r.status, r.poses, command) == Status::kOk);
  CHECK((command.q_target - r.status.q_commanded).cwiseAbs().maxCoeff() < 0.1);
}

TEST_CASE("A plan that begins amid a recorded motion judges by what it saw itself") {
  SkillController controller = MakeController();
  Readings r;
  ArmCommand command;
  std::vector<Skill> plan = Plan({2});
  REQUIRE(controller.Start(1, plan) == Status::kOk);  // the object moves by 20 cm under this one
  for (int tick = 0; tick < 3; ++tick) {
    r.Advance();
    r.poses.objects[0].X_WO.p.z() += 0.1;
    (void)controller.Tick(r.status, r.poses, command);
  }
  plan[0].record.rested.fill(false);
  plan[0].record.moved[0] = 0.1f;
  REQUIRE(controller.Start(2, plan) == Status::kOk);
  while (controller.player().playing()) {
    r.Advance();
    (void)controller.Tick(r.status, r.poses, command);
  }
  CHECK(controller.player().status().end_reason == EndReason::kNoEffect);
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
  r.Advance();
  CHECK(controller.Tick(r.status, r.poses, command) == Status::kFinished);
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
  Readings r;
  const auto library = FourDemonstrations(r);
  SkillController controller = MakeController(0, library);
  ArmCommand command;
  REQUIRE(controller.Start(1, Plan({40, 40, 40})) == Status::kOk);
  int played = 0, shortest = 5;
  const AllocationCounter counter;
  for (int i = 0; i < 200; ++i) {
    r.Advance();
    played += controller.Tick(r.status, r.poses, command) == Status::kOk;
    if (i == 130) (void)controller.Start(2, std::span<const Skill>(library->skills).first(5));
    if (i > 130) shortest = std::min(shortest, controller.player().status().n_skills);
  }
  const auto n = counter.count();
  CHECK(n == 0);
  CHECK(played == 120 + 10 + 10 + 6 + 6);
  CHECK(shortest == 3);  // another demonstration's skills were put in
}

}  // namespace
}  // namespace intabs
