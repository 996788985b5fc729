#include "intabs/skills/state.h"

#include <catch2/catch.hpp>
#include <limits>

namespace intabs {
namespace {

const JointVector kHome = (JointVector() << 0, 0.3, 1.2, 0, 0.9, 0).finished();

TEST_CASE("State features put the object into the gripper's frame") {
  const ArmModel arm = ArmModel::Lite6();
  Observation o;
  o.q = kHome;
  o.gripper_closed = true;
  o.objects[1].id = 1;
  o.objects[1].valid = true;
  // 5 cm below the tip of a gripper that points down, axes as the world's: R_WG turns by pi about x.
  o.objects[1].X_WO.p = arm.Tip(kHome).p - Eigen::Vector3d(0, 0, 0.05);
  StateVector s;
  REQUIRE(AssembleState(arm, o, s) == Status::kOk);
  CHECK((s.head<6>().cast<double>() - kHome).norm() < 1e-6);
  CHECK(s[6] == 1.f);
  CHECK(s.segment<kObjectDim>(kAgentDim).isZero());  // slot 0 was never seen
  const auto f = s.segment<kObjectDim>(kAgentDim + kObjectDim);
  CHECK(std::abs(f[0]) < 1e-4);
  CHECK(std::abs(f[1]) < 1e-4);
  CHECK(std::abs(f[2] - 0.05f) < 1e-4);
  CHECK(std::abs(f[3] - 1.f) < 1e-4);  // e_x of the object seen from the gripper
  CHECK(std::abs(f[7] + 1.f) < 1e-4);  // e_y
  CHECK(f[9] == 1.f);
}

TEST_CASE("Moving object and arm together about the base leaves the object's features as they are") {
  const ArmModel arm = ArmModel::Lite6();
  Observation a;
  a.q = kHome;
  a.objects[0].id = 0;
  a.objects[0].X_WO = {{0.3, 0.05, 0.02}, ExpSO3({0, 0, 0.4})};
  Observation b = a;
  b.q[0] += 0.7;
  const Pose turn{Eigen::Vector3d::Zero(), ExpSO3({0, 0, 0.7})};
  b.objects[0].X_WO = turn * a.objects[0].X_WO;
  StateVector sa, sb;
  REQUIRE(AssembleState(arm, a, sa) == Status::kOk);
  REQUIRE(AssembleState(arm, b, sb) == Status::kOk);
  CHECK((sa.segment<kObjectDim>(kAgentDim) - sb.segment<kObjectDim>(kAgentDim)).norm() < 1e-5f);
}

TEST_CASE("State features refuse what is not finite") {
  const ArmModel arm = ArmModel::Lite6();
  StateVector s;
  Observation o;
  o.q[3] = std::numeric_limits<double>::quiet_NaN();
  CHECK(AssembleState(arm, o, s) == Status::kInvalidInput);
  o.q[3] = 0;
  o.objects[2].id = 2;
  o.objects[2].X_WO.p.x() = std::numeric_limits<double>::infinity();
  CHECK(AssembleState(arm, o, s) == Status::kInvalidInput);
}

TEST_CASE("An object's motion is told in the gripper's axes") {
  const Pose X_WG{{0.3, 0, 0.1}, ExpSO3({0, 0, M_PI / 2})};
  const Pose from{{0.3, 0, 0}, ExpSO3({0.1, 0, 0})};
  const Pose to{{0.3, 0.01, 0}, ExpSO3({0, 0, 0.02}) * ExpSO3({0.1, 0, 0})};
  const auto m = ObjectMotion(X_WG, from, to);
  CHECK(std::abs(m[0] - 0.01f) < 1e-6);  // W's y is G's x
  CHECK(std::abs(m[1]) < 1e-6);
  CHECK(std::abs(m[5] - 0.02f) < 1e-6);
  CHECK(m.segment<2>(3).norm() < 1e-6);
}

}  // namespace
}  // namespace intabs
