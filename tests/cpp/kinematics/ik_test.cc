#include "intabs/kinematics/ik.h"

#include <algorithm>
#include <catch2/catch.hpp>
#include <chrono>
#include <cstdio>
#include <limits>
#include <numbers>
#include <vector>

#include "intabs/kinematics/urdf.h"
#include "kinematics/random_arm.h"

namespace intabs {
namespace {

std::string SayPose(const Pose& X) {
  std::ostringstream text;
  text.precision(17);
  text << "X_BG: p " << X.p.transpose() << ", q xyzw " << X.q.coeffs().transpose();
  return text.str();
}

// Whatever is answered must be right: FK gives the pose, the limits hold.
void CheckAnswer(const ArmModel& arm, const Pose& X, const JointVector& q) {
  const Pose X_answer = arm.Tip(q);
  REQUIRE((X_answer.p - X.p).norm() <= 1e-5);
  REQUIRE(AngleBetween(X_answer.q, X.q) <= 1e-4);
  REQUIRE((q - arm.q_min()).minCoeff() >= 0);
  REQUIRE((arm.q_max() - q).minCoeff() >= 0);
}

// Solves random reachable poses from random seeds; prints what fails and how long it took; returns how many
// failed.
int CountFailures(const ArmModel& arm, IkChoice choice, int n, int seed, const char* name) {
  const IkSolver ik(arm);
  std::mt19937_64 random(seed);
  std::vector<double> us;
  int failures = 0;
  for (int k = 0; k < n; ++k) {
    const JointVector q = RandomJoints(arm, random);
    const JointVector q_seed = RandomJoints(arm, random);
    const Pose X = arm.Tip(q);
    const auto start = std::chrono::steady_clock::now();
    const IkResult result = ik.Solve(X, q_seed, choice);
    us.push_back(std::chrono::duration<double, std::micro>(std::chrono::steady_clock::now() - start).count());
    INFO(Say(q) << "; seed: " << Say(q_seed));
    if (result.ok) {
      CheckAnswer(arm, X, result.q);
    } else {
      ++failures;
      std::printf("  not solved: %s; seed: %s: %s\n", Say(q).c_str(), Say(q_seed).c_str(),
                  result.why.c_str());
    }
  }
  std::sort(us.begin(), us.end());
  std::printf("%s: %d of %d solved, median %.1f us, p99 %.1f us, max %.1f us\n", name, n - failures, n,
              us[n / 2], us[n * 99 / 100], us.back());
  return failures;
}

TEST_CASE("Of 10,000 random reachable poses at least 99.9 % are solved, each within 1e-5 m and 1e-4 rad") {
  const ArmModel arm = LoadArmModel(kUrdf);
  CHECK(CountFailures(arm, IkChoice::kNearest, 10000, 11, "nearest") <= 10);
  CHECK(CountFailures(arm, IkChoice::kBestScore, 2000, 12, "best score") <= 2);
}

TEST_CASE("A calibrated arm, joint origins millimetres off, is solved as well") {
  ArmParameters a = ArmModel::Lite6().parameters();
  std::mt19937_64 random(13);
  std::uniform_real_distribution<double> mm(-1.5e-3, 1.5e-3), rad(-5e-3, 5e-3);
  for (Pose& X : a.X_PJ) {
    X.p += Eigen::Vector3d(mm(random), mm(random), mm(random));
    X.q = (X.q * ExpSO3({rad(random), rad(random), rad(random)})).normalized();
  }
  CHECK(CountFailures(ArmModel(a), IkChoice::kNearest, 10000, 14, "calibrated arm") <= 10);
}

TEST_CASE("Poses at singularities and at joint limits are solved") {
  const ArmModel arm = ArmModel::Lite6();
  const IkSolver ik(arm);
  std::mt19937_64 random(15);
  for (int k = 0; k < 3000; ++k) {
    JointVector q = RandomJoints(arm, random);
    const double tiny = k % 2 ? std::pow(10, std::uniform_real_distribution<double>(-12, -2)(random)) : 0;
    switch (k % 3) {
      case 0:
        q[4] = tiny;
        break;  // straight wrist
      case 1:
        q[2] = std::numbers::pi / 2 + std::atan2(0.22761, 0.087) - tiny;
        break;  // straight arm
      case 2:
        q[k % 6] = k % 4 ? arm.q_max()[k % 6] - tiny : arm.q_min()[k % 6] + tiny;  // at a limit
    }
    const Pose X = arm.Tip(q);
    const JointVector q_seed = RandomJoints(arm, random);
    INFO(Say(q) << "; seed: " << Say(q_seed));
    const IkResult result = ik.Solve(X, q_seed);
    INFO(result.why);
    REQUIRE(result.ok);
    CheckAnswer(arm, X, result.q);
  }
}

TEST_CASE("Seeded with the joint angles behind a pose, the solver gives them back") {
  const ArmModel arm = ArmModel::Lite6();
  const IkSolver ik(arm);
  std::mt19937_64 random(16);
  for (int k = 0; k < 2000; ++k) {
    const JointVector q = RandomJoints(arm, random);
    if (ArmScore(arm, q) < 0.01) continue;  // beside a singularity many answers are within the tolerance
    INFO(Say(q));
    const IkResult result = ik.Solve(arm.Tip(q), q);
    REQUIRE(result.ok);
    REQUIRE((result.q - q).norm() < 1e-6);
    REQUIRE(result.score == Approx(ArmScore(arm, q)).margin(1e-5));
  }
}

TEST_CASE("The best score is never below that of the nearest answer, nor of the angles that made the pose") {
  const ArmModel arm = ArmModel::Lite6();
  const IkSolver ik(arm);
  std::mt19937_64 random(17);
  int better = 0;
  for (int k = 0; k < 1000; ++k) {
    const JointVector q = RandomJoints(arm, random);
    INFO(Say(q));
    const IkResult nearest = ik.Solve(arm.Tip(q), q);
    const IkResult best = ik.Solve(arm.Tip(q), q, IkChoice::kBestScore);
    REQUIRE(nearest.ok);
    REQUIRE(best.ok);
    REQUIRE(best.score >= nearest.score - 1e-5);
    REQUIRE(best.score >= ArmScore(arm, q) - 1e-5);
    better += best.score > nearest.score + 1e-5;
  }
  CHECK(better > 100);
}

TEST_CASE("A straight line is followed without a jump when each answer seeds the next") {
  const ArmModel arm = ArmModel::Lite6();
  const IkSolver ik(arm);
  const Eigen::Quaterniond down(0, 1, 0, 0);
  JointVector q;
  q << 0, .3, 1.2, 0, .9, 0;
  for (int k = 0; k <= 200; ++k) {
    const double s = k / 200.0;
    const Pose X{{0.25 + 0.1 * s, -0.15 + 0.3 * s, 0.15 - 0.05 * s}, (down * ExpSO3({0, 0, s})).normalized()};
    const IkResult result = ik.Solve(X, q);
    INFO(SayPose(X) << ": " << result.why);
    REQUIRE(result.ok);
    if (k > 0) REQUIRE((result.q - q).cwiseAbs().maxCoeff() < 0.05);
    q = result.q;
  }
}

TEST_CASE("Unreachable poses are refused, never answered with a wrong one") {
  const ArmModel arm = ArmModel::Lite6();
  const IkSolver ik(arm);
  std::mt19937_64 random(18);
  std::uniform_real_distribution<double> unit(-1, 1);
  int refused = 0;
  for (int k = 0; k < 3000; ++k) {
    // Anywhere in a box that is larger than the arm's reach.
    const Pose X{{0.8 * unit(random), 0.8 * unit(random), 0.3 + 0.8 * unit(random)},
                 Eigen::Quaterniond(unit(random), unit(random), unit(random), unit(random)).normalized()};
    INFO(SayPose(X));
    const IkResult result =
        ik.Solve(X, JointVector::Zero(), k % 2 ? IkChoice::kBestScore : IkChoice::kNearest);
    // Shoulder to wrist: at most 0.2002 + |(0.087, 0.22761)|.
    const Pose X_BE = X * arm.parameters().X_EG.Inverse();
    const double reach =
        (X_BE.p - X_BE.q * Eigen::Vector3d(0, 0, 0.0625) - Eigen::Vector3d(0, 0, 0.2435)).norm();
    if (result.ok) {
      CheckAnswer(arm, X, result.q);
      REQUIRE(reach < 0.4439);
    } else {
      REQUIRE_FALSE(result.why.empty());
      ++refused;
    }
  }
  CHECK(refused > 1000);
  CHECK(refused < 2900);
}

TEST_CASE("A pose a hair beyond the reach is refused with the reason") {
  const ArmModel arm = ArmModel::Lite6();
  const IkSolver ik(arm);
  JointVector q = JointVector::Zero();
  q[1] = 0.5;
  q[2] = std::numbers::pi / 2 + std::atan2(0.22761, 0.087);  // straight arm
  Pose X = arm.Tip(q);
  const Eigen::Vector3d outwards = (X.p - Eigen::Vector3d(0, 0, 0.2435)).normalized();
  REQUIRE(ik.Solve(X, q).ok);
  X.p += 1e-3 * outwards;
  const IkResult near = ik.Solve(X, q);
  CHECK_FALSE(near.ok);
  X.p += 0.3 * outwards;
  const IkResult far = ik.Solve(X, q);
  CHECK_FALSE(far.ok);
  for (const IkResult& r : {near, far}) CHECK_THAT(r.why, Catch::Matchers::Contains("out of reach"));
}

TEST_CASE("A pose that only joint angles beyond the limits reach is refused") {
  const ArmModel arm = ArmModel::Lite6();
  ArmParameters tight = arm.parameters();
  tight.q_min.setConstant(-0.1);
  tight.q_max.setConstant(0.1);
  JointVector q;
  q << 1, .3, 1.2, 0, .9, 0;
  const IkResult result = IkSolver(ArmModel(tight)).Solve(arm.Tip(q), q);
  CHECK_FALSE(result.ok);
  CHECK_THAT(result.why, Catch::Matchers::Contains("joint limits"));
}

TEST_CASE("Poses that are not finite or whose quaternion is not of unit norm are refused") {
  const ArmModel arm = ArmModel::Lite6();
  const IkSolver ik(arm);
  const JointVector q = JointVector::Constant(0.3);
  Pose X = arm.Tip(q);
  X.p.x() = std::numeric_limits<double>::quiet_NaN();
  CHECK_FALSE(ik.Solve(X, q).ok);
  X = arm.Tip(q);
  X.q.coeffs() *= 0.5;
  CHECK_THAT(ik.Solve(X, q).why, Catch::Matchers::Contains("norm 0.5"));
  JointVector seed = q;
  seed[2] = std::numeric_limits<double>::infinity();
  CHECK_FALSE(ik.Solve(arm.Tip(q), seed).ok);
}

}  // namespace
}  // namespace intabs
