#include "intabs/kinematics/urdf.h"

#include <catch2/catch.hpp>
#include <filesystem>
#include <fstream>
#include <iterator>

#include "kinematics/random_arm.h"

namespace intabs {
namespace {

using Catch::Matchers::Contains;

// A copy of the arm's URDF with one thing changed.
class ChangedUrdf {
 public:
  ChangedUrdf(const std::string& from, const std::string& to) {
    std::ifstream in(kUrdf);
    std::string text((std::istreambuf_iterator<char>(in)), std::istreambuf_iterator<char>());
    const size_t at = text.find(from);
    REQUIRE(at != std::string::npos);
    std::ofstream(path_) << text.replace(at, from.size(), to);
  }
  ~ChangedUrdf() { std::filesystem::remove(path_); }
  const std::string& path() const { return path_; }

 private:
  std::string path_ = (std::filesystem::temp_directory_path() / "intabs_urdf_test.urdf").string();
};

std::string Complaint(const std::string& path, const std::string& tip = "tip") {
  try {
    LoadArmModel(path, "link_base", tip);
  } catch (const std::runtime_error& e) {
    const std::string what = e.what();
    CHECK_THAT(what, Contains(path));
    CHECK(what.find('\n') == std::string::npos);
    return what;
  }
  return "";
}

TEST_CASE("A URDF that is not there, not a URDF or not this arm is named in one line") {
  CHECK_THAT(Complaint("/no/such/arm.urdf"), Contains("cannot be read"));
  CHECK_THAT(Complaint(std::filesystem::temp_directory_path().string()), Contains("cannot be read"));
  CHECK_THAT(Complaint(ChangedUrdf("<robot", "<rabot").path()), Contains("not a valid URDF"));
  CHECK_THAT(Complaint(ChangedUrdf("<link name=\"tip\"/>", "<link name=\"top\"/>").path()),
             Contains("not a valid URDF"));
  CHECK_THAT(Complaint(kUrdf, "tool"), Contains("has no link \"tool\""));
}

TEST_CASE("A missing joint, a wrong number of joints, a wrong axis and missing limits are refused") {
  SECTION("missing joint") {
    const ChangedUrdf urdf("<joint name=\"tip\" type=\"fixed\">\n    <parent link=\"link6\"/>",
                           "<joint name=\"tip\" type=\"fixed\">\n    <parent link=\"elsewhere\"/>");
    CHECK_THAT(Complaint(urdf.path()), Contains("not a valid URDF"));
  }
  SECTION("one too few") {
    CHECK_THAT(Complaint(kUrdf, "link5"),
               Contains("has 5 moving joints") && Contains("joint1 joint2 joint3 joint4 joint5"));
  }
  SECTION("one fixed") {
    const ChangedUrdf urdf("<joint name=\"joint3\" type=\"revolute\">",
                           "<joint name=\"joint3\" type=\"fixed\">");
    CHECK_THAT(Complaint(urdf.path()), Contains("has 5 moving joints"));
  }
  SECTION("one too many, and not revolute") {
    CHECK_THAT(Complaint(kUrdf, "finger_left"), Contains("joint \"finger_left\" is not of type revolute"));
  }
  SECTION("axis") {
    const ChangedUrdf urdf("<axis xyz=\"0 0 1\"/>", "<axis xyz=\"0 1 0\"/>");
    CHECK_THAT(Complaint(urdf.path()), Contains("joint \"joint1\" has axis \"0 1 0\""));
  }
  SECTION("limits") {
    const ChangedUrdf urdf("lower=\"-6.283185307179586\" upper=\"6.283185307179586\"",
                           "lower=\"1\" upper=\"-1\"");
    CHECK_THAT(Complaint(urdf.path()), Contains("joint \"joint1\" needs limits"));
  }
}

TEST_CASE("A calibrated joint origin and a fixed joint in mid-chain arrive in the arm model") {
  const ArmModel nominal = LoadArmModel(kUrdf);
  const ChangedUrdf urdf("xyz=\"0.2002 0 0\"", "xyz=\"0.2012 0 0\"");
  const ArmModel arm = LoadArmModel(urdf.path());
  const JointVector q = JointVector::Zero();  // the upper arm stands upright
  CHECK(arm.Fk(q).p.z() - nominal.Fk(q).p.z() == Approx(0.001).margin(1e-12));
  CHECK(LoadArmModel(kUrdf, "link_base", "link6").parameters().X_EG.p.norm() == 0);
}

}  // namespace
}  // namespace intabs
