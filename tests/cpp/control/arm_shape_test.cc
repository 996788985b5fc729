// The bodies of control/arm_shape.h against models/lite6/lite6.xml in MuJoCo.
#include <mujoco/mujoco.h>

#include <catch2/catch.hpp>
#include <memory>
#include <random>
#include <set>
#include <string>

#include "intabs/core/types.h"
#include "reference_shape.h"

namespace intabs {
namespace {

using lite6_shape::kCapsules;

struct Arm {
  Arm() {
    char error[500] = "";
    model.reset(mj_loadXML(INTABS_SOURCE_DIR "/models/lite6/lite6.xml", nullptr, error, sizeof error));
    if (!model) FAIL(error);
    data.reset(mj_makeData(model.get()));
  }
  void Pose(const JointVector& q, double opening) {
    for (int i = 0; i < kNumJoints; ++i) data->qpos[i] = q[i];
    data->qpos[6] = data->qpos[7] = opening;
    mj_kinematics(model.get(), data.get());
    mj_collision(model.get(), data.get());
  }
  // 0 base .. 6 flange and everything on it.
  int Link(int geom) const {
    const std::string name = mj_id2name(model.get(), mjOBJ_BODY, model->geom_bodyid[geom]);
    if (name == "link_base") return 0;
    return name.rfind("link", 0) == 0 ? name[4] - '0' : 6;
  }
  bool Collides(int geom) const { return model->geom_contype[geom] != 0; }
  // A point of its surface, in W: u, v, w in [-1, 1].
  Eigen::Vector3d Surface(int geom, double u, double v, double w) const {
    const mjtNum* s = model->geom_size + 3 * geom;
    Eigen::Vector3d x;
    if (model->geom_type[geom] == mjGEOM_BOX) {
      x << s[0] * u, s[1] * v, s[2] * w;
      int face = 0;
      x.cwiseQuotient(Eigen::Vector3d(s[0], s[1], s[2])).cwiseAbs().maxCoeff(&face);
      x[face] = std::copysign(s[face], x[face]);
    } else {
      REQUIRE(model->geom_type[geom] == mjGEOM_CYLINDER);
      const double around = M_PI * u;
      x << s[0] * std::cos(around), s[0] * std::sin(around),
          std::abs(v) < 0.5 ? s[1] * w : std::copysign(s[1], v);
    }
    const Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>> R(data->geom_xmat + 9 * geom);
    return Eigen::Map<const Eigen::Vector3d>(data->geom_xpos + 3 * geom) + R * x;
  }
  std::unique_ptr<mjModel, void (*)(mjModel*)> model{nullptr, mj_deleteModel};
  std::unique_ptr<mjData, void (*)(mjData*)> data{nullptr, mj_deleteData};
};

JointVector RandomPose(std::mt19937& random) {
  const ArmModel arm = ArmModel::Lite6();
  std::uniform_real_distribution<double> u(0, 1);
  return JointVector::NullaryExpr(
      [&](Eigen::Index i) { return arm.q_min()[i] + u(random) * (arm.q_max()[i] - arm.q_min()[i]); });
}

}  // namespace

TEST_CASE("Every point of the arm's collision geometry lies in a capsule of its link") {
  Arm arm;
  std::mt19937 random(1);
  std::uniform_real_distribution<double> u(-1, 1);
  for (const double opening : {0.0, 0.0089}) {
    arm.Pose(JointVector::Zero(), opening);
    for (int geom = 0; geom < arm.model->ngeom; ++geom) {
      if (!arm.Collides(geom)) continue;
      const int link = arm.Link(geom);
      const std::string body = link == 0 ? "link_base" : "link" + std::to_string(link);
      const int id = mj_name2id(arm.model.get(), mjOBJ_BODY, body.c_str());
      const Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>> R(arm.data->xmat + 9 * id);
      const Eigen::Map<const Eigen::Vector3d> p(arm.data->xpos + 3 * id);
      for (int k = 0; k < 3000; ++k) {
        const Eigen::Vector3d x = R.transpose() * (arm.Surface(geom, u(random), u(random), u(random)) - p);
        double outside = 1e9;
        for (const auto& c : kCapsules) {
          if (c.link != link) continue;
          const Eigen::Vector3d p0(c.p0[0], c.p0[1], c.p0[2]), p1(c.p1[0], c.p1[1], c.p1[2]);
          const double t = std::clamp((x - p0).dot(p1 - p0) / (p1 - p0).squaredNorm(), 0.0, 1.0);
          outside = std::min(outside, (x - p0 - t * (p1 - p0)).norm() - c.radius);
        }
        if (outside > 0.0005) {
          FAIL(mj_id2name(arm.model.get(), mjOBJ_GEOM, geom)
               << " at " << x.transpose() << " is " << outside << " m outside");
        }
      }
    }
  }
}

TEST_CASE("Where MuJoCo sees the arm touch itself the capsules overlap, in 20,000 random poses") {
  Arm arm;
  std::mt19937 random(2);
  int touching = 0, near = 0;
  for (int k = 0; k < 20000; ++k) {
    const JointVector q = RandomPose(random);
    arm.Pose(q, k % 2 == 0 ? 0 : 0.0089);
    bool touches = false;
    for (int i = 0; i < arm.data->ncon; ++i) touches |= arm.data->contact[i].dist < 0;
    const double self = Measure(ArmModel::Lite6(), q).self;
    touching += touches;
    near += self < 0;
    INFO("q " << q.transpose());
    if (touches) REQUIRE(self < 0.0005);
  }
  CHECK(touching > 1000);
  // And are not much too careful: of the poses they forbid most do touch, or nearly.
  CHECK(near < 1.6 * touching);
}

TEST_CASE("The height above the table is that of the lowest point of the links that can get there") {
  Arm arm;
  std::mt19937 random(3);
  std::uniform_real_distribution<double> u(-1, 1);
  for (int k = 0; k < 300; ++k) {
    const JointVector q = RandomPose(random);
    arm.Pose(q, 0.0089);
    double lowest = 1e9;
    for (int geom = 0; geom < arm.model->ngeom; ++geom) {
      if (!arm.Collides(geom) || arm.Link(geom) < 2) continue;
      for (int i = 0; i < 300; ++i)
        lowest = std::min(lowest, arm.Surface(geom, u(random), u(random), u(random)).z());
    }
    INFO("q " << q.transpose());
    const double table = Measure(ArmModel::Lite6(), q).table;
    // The shoulder end of the upper arm, always over .2 m high, is left out.
    if (table < 0.19) {
      REQUIRE(table <= lowest + 0.0005);
      REQUIRE(table >= lowest - 0.02);
    }
  }
}

TEST_CASE("The pairs that are watched are those that the model does not exclude") {
  Arm arm;
  const auto excluded = [&arm](const std::string& a, const std::string& b) {
    const int i = mj_name2id(arm.model.get(), mjOBJ_BODY, a.c_str()),
              j = mj_name2id(arm.model.get(), mjOBJ_BODY, b.c_str());
    const int signature = (std::min(i, j) + 1) * 65536 + std::max(i, j) + 1,
              other = (std::min(i, j) << 16) + std::max(i, j);
    for (int k = 0; k < arm.model->nexclude; ++k) {
      if (arm.model->exclude_signature[k] == signature || arm.model->exclude_signature[k] == other)
        return true;
    }
    return false;
  };
  REQUIRE(excluded("link1", "link2"));
  REQUIRE_FALSE(excluded("link_base", "link3"));
  const auto body = [](int link) {
    return link == 0   ? std::string("link_base")
           : link == 6 ? std::string("gripper")
                       : "link" + std::to_string(link);
  };
  std::set<std::pair<int, int>> watched;
  for (const auto& pair : lite6_shape::kPairs)
    watched.insert({kCapsules[pair.a].link, kCapsules[pair.b].link});
  for (int a = 0; a <= 6; ++a) {
    for (int b = a + 1; b <= 6; ++b) {
      INFO(body(a) << " " << body(b));
      CHECK((watched.count({a, b}) == 1) == !excluded(body(a), body(b)));
    }
  }
  // Every capsule of the one with every capsule of the other.
  size_t expected = 0;
  for (const auto& [a, b] : watched) {
    const auto count = [](int link) {
      return std::count_if(kCapsules.begin(), kCapsules.end(),
                           [link](const auto& c) { return c.link == link; });
    };
    expected += count(a) * count(b);
  }
  CHECK(expected == lite6_shape::kPairs.size());
}

}  // namespace intabs
