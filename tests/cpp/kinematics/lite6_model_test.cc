// models/lite6: the URDF, the MJCF, KDL, MuJoCo and ArmModel must all be the same arm.
#include <mujoco/mujoco.h>

#include <catch2/catch.hpp>
#include <filesystem>
#include <fstream>
#include <kdl/chain.hpp>
#include <kdl/chaindynparam.hpp>
#include <kdl/chainfksolverpos_recursive.hpp>
#include <kdl/chainjnttojacsolver.hpp>
#include <memory>
#include <vector>

#include "intabs/kinematics/urdf.h"
#include "kinematics/random_arm.h"

namespace intabs {
namespace {

// The MJCF, loaded.
class Mujoco {
 public:
  explicit Mujoco(const std::string& path = kMjcf) {
    char error[1000] = "";
    model_.reset(mj_loadXML(path.c_str(), nullptr, error, sizeof(error)));
    INFO(error);
    REQUIRE(model_);
    data_.reset(mj_makeData(model_.get()));
  }

  mjModel& m() { return *model_; }
  mjData& d() { return *data_; }
  int Id(mjtObj type, const char* name) {
    const int id = mj_name2id(model_.get(), type, name);
    INFO(name);
    REQUIRE(id >= 0);
    return id;
  }

  void SetJoints(const JointVector& q, const JointVector& dq = JointVector::Zero()) {
    mj_resetData(model_.get(), data_.get());
    for (int i = 0; i < kNumJoints; ++i) {
      const int joint = Id(mjOBJ_JOINT, ("joint" + std::to_string(i + 1)).c_str());
      data_->qpos[model_->jnt_qposadr[joint]] = q[i];
      data_->qvel[model_->jnt_dofadr[joint]] = dq[i];
    }
    mj_forward(model_.get(), data_.get());
  }

  Pose Site(const char* name) {
    const int id = Id(mjOBJ_SITE, name);
    const Eigen::Matrix3d R =
        Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(data_->site_xmat + 9 * id);
    return {Eigen::Vector3d(data_->site_xpos + 3 * id), Eigen::Quaterniond(R)};
  }

  // As if the arm carried nothing.
  void WeighGripperAsNothing() {
    for (const char* name : {"gripper", "finger_left", "finger_right"}) {
      const int body = Id(mjOBJ_BODY, name);
      model_->body_mass[body] = 0;
      mju_zero3(model_->body_inertia + 3 * body);
    }
    mj_setConst(model_.get(), data_.get());
  }

 private:
  struct Delete {
    void operator()(mjModel* m) const { mj_deleteModel(m); }
    void operator()(mjData* d) const { mj_deleteData(d); }
  };
  std::unique_ptr<mjModel, Delete> model_;
  std::unique_ptr<mjData, Delete> data_;
};

KDL::JntArray ToKdl(const JointVector& q) {
  KDL::JntArray out(kNumJoints);
  out.data = q;
  return out;
}

JointVector Joints(double a, double b, double c, double d, double e, double f) {
  JointVector q;
  q << a, b, c, d, e, f;
  return q;
}

struct Golden {
  const char* name;
  JointVector q;
  Pose X_BE;
  Eigen::Vector3d p_BG;
};

// Computed from the vendor's joint frames with exact multiples of pi; nine decimals.
std::vector<Golden> GoldenPoses() {
  return {
      {"zero", Joints(0, 0, 0, 0, 0, 0), {{0.087, 0, 0.15359}, {0, 1, 0, 0}}, {0.087, 0, 0.06999}},
      {"home",
       Joints(0, 0, 1.57, 0, 1.57, 0),
       {{0.227679208, 0, 0.468018720}, {0, 1, 0, 0}},
       {0.227679208, 0, 0.384418720}},
      {"down",
       Joints(0, .3, 1.2, 0, .9, 0),
       {{0.291536251, 0, 0.298923161}, {0, 1, 0, 0}},
       {0.291536251, 0, 0.215323161}},
      {"g1",
       Joints(.5, -.4, 1, -.7, .6, 1.1),
       {{0.192883003, 0.079466592, 0.439578153}, {0.061388541, -0.8813264, 0.078696129, -0.46184645}},
       {0.261747418, 0.082435699, 0.392272374}},
      {"g2",
       Joints(-1.2, .8, 2.2, 1.5, -.9, -2.3),
       {{0.107244208, -0.410619293, 0.426838016}, {0.68722352, 0.600015272, -0.406824593, 0.046896245}},
       {0.065203278, -0.482753244, 0.422570307}},
      {"g3",
       Joints(2.5, -1.1, .4, -2.9, 1.9, 3),
       {{-0.022520943, 0.034486028, 0.463703059}, {0.900781842, -0.082784918, 0.153147918, -0.397849778}},
       {0.006051668, 0.036766851, 0.542235624}},
  };
}

TEST_CASE("The arm's line goes through the links of the MJCF, and distances are those from its part beyond the elbow") {
  Mujoco mujoco;
  const ArmModel arm = ArmModel::Lite6();
  for (const Golden& golden : GoldenPoses()) {
    INFO(golden.name);
    mujoco.SetJoints(golden.q);
    const ArmModel::Line line = arm.Places(golden.q);
    for (int i = 0; i < kNumJoints; ++i) {
      const int body = mujoco.Id(mjOBJ_BODY, ("link" + std::to_string(i + 1)).c_str());
      CHECK((line[i + 1] - Eigen::Vector3d(mujoco.d().xpos + 3 * body)).norm() < 1e-6);
    }
    CHECK((line.back() - golden.p_BG).norm() < 1e-6);
    for (const Eigen::Vector3d& p : {Eigen::Vector3d(0.2, 0.1, 0.1), Eigen::Vector3d(-0.1, 0.3, 0.5), line[5], line[2]}) {
      double least = 1e9;
      for (size_t i = 4; i < line.size(); ++i)
        for (int k = 0; k <= 1000; ++k)
          least = std::min(least, (line[i - 1] + 0.001 * k * (line[i] - line[i - 1]) - p).norm());
      CHECK(arm.DistanceFrom(golden.q, p) == Approx(least).margin(2e-4));
    }
  }
}

TEST_CASE("The golden poses come out of the built-in arm, the URDF and the MJCF alike") {
  Mujoco mujoco;
  const ArmModel built_in = ArmModel::Lite6();
  const ArmModel urdf = LoadArmModel(kUrdf);
  for (const Golden& golden : GoldenPoses()) {
    INFO(golden.name);
    mujoco.SetJoints(golden.q);
    const auto check = [&](const char* who, const Pose& X_BE, const Eigen::Vector3d& p_BG) {
      INFO(who << ": p_BE " << X_BE.p.transpose() << ", q_BE xyzw " << X_BE.q.coeffs().transpose()
               << ", p_BG " << p_BG.transpose());
      CHECK((X_BE.p - golden.X_BE.p).norm() < 1e-6);
      CHECK(AngleBetween(X_BE.q, golden.X_BE.q.normalized()) < 1e-6);
      CHECK((p_BG - golden.p_BG).norm() < 1e-6);
    };
    check("built-in", built_in.Fk(golden.q), built_in.Tip(golden.q).p);
    check("URDF", urdf.Fk(golden.q), urdf.Tip(golden.q).p);
    check("MJCF", mujoco.Site("flange"), mujoco.Site("tip").p);
    CHECK(mujoco.d().ncon == 0);
  }
}

TEST_CASE("At random joint angles the URDF, the MJCF and the built-in arm have the same tip") {
  Mujoco mujoco;
  const ArmModel built_in = ArmModel::Lite6();
  const ArmModel urdf = LoadArmModel(kUrdf);
  std::mt19937_64 random(1);
  for (int k = 0; k < 300; ++k) {
    const JointVector q = RandomJoints(built_in, random);
    INFO(Say(q));
    mujoco.SetJoints(q);
    for (const Pose& X : {urdf.Tip(q), mujoco.Site("tip")}) {
      REQUIRE((X.p - built_in.Tip(q).p).norm() < 1e-9);
      REQUIRE(AngleBetween(X.q, built_in.Tip(q).q) < 1e-7);
    }
  }
}

TEST_CASE("ArmModel's forward kinematics and Jacobian are KDL's") {
  const ArmModel arm = LoadArmModel(kUrdf);
  const KDL::Chain chain = LoadKdlChain(kUrdf);
  KDL::ChainFkSolverPos_recursive fk(chain);
  KDL::ChainJntToJacSolver jacobian(chain);
  std::mt19937_64 random(2);
  for (int k = 0; k < 1000; ++k) {
    const JointVector q = RandomJoints(arm, random);
    INFO(Say(q));
    KDL::Frame X_kdl;
    KDL::Jacobian J_kdl(kNumJoints);
    REQUIRE(fk.JntToCart(ToKdl(q), X_kdl) == 0);
    REQUIRE(jacobian.JntToJac(ToKdl(q), J_kdl) == 0);
    const Pose X = arm.Tip(q);
    const Eigen::Matrix3d R_kdl =
        Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(X_kdl.M.data);
    REQUIRE((X.p - Eigen::Vector3d(X_kdl.p.data)).norm() < 1e-12);
    REQUIRE((X.q.toRotationMatrix() - R_kdl).norm() < 1e-12);
    REQUIRE((arm.Jacobian(q) - J_kdl.data).norm() < 1e-12);
  }
}

TEST_CASE("Joint limits, efforts and the stroke of the fingers are the same in URDF and MJCF") {
  Mujoco mujoco;
  const ArmModel built_in = ArmModel::Lite6();
  const ArmModel urdf = LoadArmModel(kUrdf);
  const JointVector effort = Joints(50, 50, 32, 32, 32, 20);
  for (int i = 0; i < kNumJoints; ++i) {
    const std::string name = "joint" + std::to_string(i + 1);
    INFO(name);
    const int joint = mujoco.Id(mjOBJ_JOINT, name.c_str());
    const int actuator = mujoco.Id(mjOBJ_ACTUATOR, name.c_str());
    for (const ArmModel& arm : {built_in, urdf}) {
      CHECK(arm.q_min()[i] == Approx(mujoco.m().jnt_range[2 * joint]).epsilon(1e-12));
      CHECK(arm.q_max()[i] == Approx(mujoco.m().jnt_range[2 * joint + 1]).epsilon(1e-12));
    }
    CHECK(mujoco.m().jnt_limited[joint]);
    CHECK(mujoco.m().actuator_trnid[2 * actuator] == joint);
    CHECK(mujoco.m().actuator_forcerange[2 * actuator + 1] == effort[i]);
  }
  const KDL::Chain finger = LoadKdlChain(kUrdf, "link6", "finger_left");
  CHECK(finger.getNrOfJoints() == 1);
  for (const char* name : {"finger_left", "finger_right"}) {
    const int joint = mujoco.Id(mjOBJ_JOINT, name);
    CHECK(mujoco.m().jnt_type[joint] == mjJNT_SLIDE);
    CHECK(mujoco.m().jnt_range[2 * joint] == 0);
    CHECK(mujoco.m().jnt_range[2 * joint + 1] == 0.0089);
  }
}

TEST_CASE("Without the gripper, gravity loads the joints alike in KDL's dynamics and in MuJoCo's") {
  Mujoco mujoco;
  mujoco.WeighGripperAsNothing();
  const KDL::Chain chain = LoadKdlChain(kUrdf, "link_base", "link6");
  KDL::ChainDynParam dynamics(chain, KDL::Vector(0, 0, mujoco.m().opt.gravity[2]));
  const ArmModel arm = ArmModel::Lite6();

  std::vector<JointVector> poses;
  for (const Golden& golden : GoldenPoses()) poses.push_back(golden.q);
  std::mt19937_64 random(3);
  for (int k = 0; k < 200; ++k) poses.push_back(RandomJoints(arm, random));

  double largest = 0;
  for (const JointVector& q : poses) {
    INFO(Say(q));
    KDL::JntArray kdl(kNumJoints);
    REQUIRE(dynamics.JntToGravity(ToKdl(q), kdl) == 0);
    mujoco.SetJoints(q);
    const JointVector bias = Eigen::Map<const JointVector>(mujoco.d().qfrc_bias);
    INFO("KDL " << kdl.data.transpose() << ", MuJoCo " << bias.transpose());
    REQUIRE((kdl.data - bias).cwiseAbs().maxCoeff() < 1e-4);
    largest = std::max(largest, bias.cwiseAbs().maxCoeff());
  }
  CHECK(largest > 5);  // Nm: there was something to compare
}

TEST_CASE("Without the gripper, the mass matrix and the Coriolis forces are the same in KDL and in MuJoCo") {
  Mujoco mujoco;
  mujoco.WeighGripperAsNothing();
  mju_zero3(mujoco.m().opt.gravity);
  const KDL::Chain chain = LoadKdlChain(kUrdf, "link_base", "link6");
  KDL::ChainDynParam dynamics(chain, KDL::Vector::Zero());
  const ArmModel arm = ArmModel::Lite6();
  const int nv = mujoco.m().nv;
  std::mt19937_64 random(4);
  for (int k = 0; k < 200; ++k) {
    const JointVector q = RandomJoints(arm, random);
    const JointVector dq =
        JointVector::NullaryExpr([&] { return std::uniform_real_distribution<double>(-2, 2)(random); });
    INFO(Say(q) << ", dq = " << dq.transpose());
    mujoco.SetJoints(q, dq);
    KDL::JntSpaceInertiaMatrix mass(kNumJoints);
    KDL::JntArray coriolis(kNumJoints);
    REQUIRE(dynamics.JntToMass(ToKdl(q), mass) == 0);
    REQUIRE(dynamics.JntToCoriolis(ToKdl(q), ToKdl(dq), coriolis) == 0);
    std::vector<double> full(nv * nv);
    mj_fullM(&mujoco.m(), full.data(), mujoco.d().qM);
    Eigen::MatrixXd M =
        Eigen::Map<Eigen::MatrixXd>(full.data(), nv, nv).topLeftCorner(kNumJoints, kNumJoints);
    M.diagonal().array() -= 0.1;  // armature
    REQUIRE((M - mass.data).cwiseAbs().maxCoeff() < 1e-6);
    REQUIRE((Eigen::Map<const JointVector>(mujoco.d().qfrc_bias) - coriolis.data).cwiseAbs().maxCoeff() <
            1e-6);
  }
}

TEST_CASE("The gripper weighs the same in URDF and MJCF") {
  Mujoco mujoco;
  const std::pair<const char*, const char*> bodies[] = {
      {"link6", "gripper"}, {"gripper", "finger_left"}, {"gripper", "finger_right"}};
  for (const auto& [parent, name] : bodies) {
    INFO(name);
    const KDL::Chain chain = LoadKdlChain(kUrdf, parent, name);
    KDL::RigidBodyInertia urdf = chain.getSegment(0).getInertia();
    const int body = mujoco.Id(mjOBJ_BODY, name);
    CHECK(mujoco.m().body_mass[body] == Approx(urdf.getMass()));
    const Eigen::Vector3d com(mujoco.m().body_ipos + 3 * body);
    CHECK((com - Eigen::Vector3d(urdf.getCOG().data)).norm() < 1e-9);
    double R[9];
    mju_quat2Mat(R, mujoco.m().body_iquat + 4 * body);
    const Eigen::Matrix3d R_LI = Eigen::Map<Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(R);
    const Eigen::Matrix3d I =
        R_LI * Eigen::Vector3d(mujoco.m().body_inertia + 3 * body).asDiagonal() * R_LI.transpose();
    const KDL::RigidBodyInertia about_com = urdf.RefPoint(urdf.getCOG());
    const Eigen::Matrix3d I_urdf = Eigen::Map<const Eigen::Matrix3d>(about_com.getRotationalInertia().data);
    CHECK((I - I_urdf).cwiseAbs().maxCoeff() < 1e-9);
  }
}

TEST_CASE("The servos hold a pose without chatter and the gripper opens and closes by its stroke") {
  // Alone, and included in a scene that lies in a folder beside the arm's.
  const std::filesystem::path dir = std::filesystem::temp_directory_path() / "intabs_lite6_model_test";
  std::filesystem::create_directories(dir / "lite6");
  std::filesystem::create_directories(dir / "scenes");
  std::filesystem::copy_file(kMjcf, dir / "lite6/lite6.xml",
                             std::filesystem::copy_options::overwrite_existing);
  std::ofstream(dir / "scenes/scene.xml") << R"(<mujoco><option cone="elliptic" impratio="100"/>
      <include file="../lite6/lite6.xml"/><worldbody><geom type="plane" size="1 1 .1"/></worldbody></mujoco>)";
  for (const std::string& path : {kMjcf, (dir / "scenes/scene.xml").string()}) {
    INFO(path);
    Mujoco mujoco(path);
    mjModel* m = &mujoco.m();
    mjData* d = &mujoco.d();
    const JointVector q = Joints(0, .3, 1.2, 0, .9, 0);
    mujoco.SetJoints(q);
    for (const double force : {10.0, -10.0}) {
      for (int k = 0; k < 1000; ++k) {
        for (int i = 0; i < kNumJoints; ++i) d->ctrl[i] = q[i];
        d->ctrl[mujoco.Id(mjOBJ_ACTUATOR, "gripper")] = force;
        mj_step1(m, d);
        mju_copy(d->qfrc_applied, d->qfrc_bias, m->nv);
        mj_step2(m, d);
      }
      CHECK(Eigen::Map<JointVector>(d->qvel).norm() < 1e-9);
      CHECK((Eigen::Map<JointVector>(d->qpos) - q).norm() < 1e-9);
      for (const char* name : {"finger_left", "finger_right"}) {
        const double x = d->qpos[m->jnt_qposadr[mujoco.Id(mjOBJ_JOINT, name)]];
        CHECK(x == Approx(force > 0 ? 0.0089 : 0).margin(1e-4));
      }
    }
  }
  std::filesystem::remove_all(dir);
}

}  // namespace
}  // namespace intabs
