// How the tasks can be done, as motions of a ScriptedArm that knows the true poses.
#pragma once

#include <vector>

#include "plant/scripted_arm.h"

namespace intabs::test {

using Eigen::Vector3d;

// The gripper pointing along `approach`, its fingers closing along `across`.
inline Eigen::Quaterniond Pointing(const Vector3d& approach, const Vector3d& across) {
  Eigen::Matrix3d R;
  R.col(2) = approach.normalized();
  R.col(1) = (across - R.col(2) * R.col(2).dot(across)).normalized();
  R.col(0) = R.col(1).cross(R.col(2));
  return Eigen::Quaterniond(R);
}

// Pointing horizontally along `ahead`, but for `tilt` [rad] downwards.
inline Eigen::Quaterniond Ahead(const Vector3d& ahead, const Vector3d& across, double tilt) {
  return Pointing(std::cos(tilt) * ahead - std::sin(tilt) * Vector3d::UnitZ(), across);
}

inline void PullDrawer(World& world, ScriptedArm& arm, double distance) {
  const Pose X_WO = world.Objects()[3].X_WO;
  const Vector3d into = X_WO.q * Vector3d::UnitX();
  const Pose grasp{X_WO.p, Pointing(-Vector3d::UnitZ(), into)};
  arm.SwingTo(ScriptedArm::Above(grasp, 0.09), 1.5);
  arm.MoveTo(grasp, 1);
  arm.Close();
  const Pose pulled{grasp.p - distance * into, grasp.q};
  arm.MoveTo(pulled, 1.5);
  arm.Open();
  arm.MoveTo(ScriptedArm::Above(pulled, 0.08), 1);
}

// Closed fingers under the tab follow its arc without turning: gripping it would lead through the wrist's singularity.
inline void PushLid(World& world, ScriptedArm& arm, double angle) {
  const Pose X_WO = world.Objects()[3].X_WO;
  const Vector3d ahead = X_WO.q * Vector3d::UnitX(), axis = X_WO.q * Vector3d::UnitY();
  const Eigen::Quaterniond q = Ahead(ahead, axis, 20 * M_PI / 180);
  const auto under = [&](double lid, double below) {
    const Vector3d tab = ExpSO3(lid * axis) * (X_WO.q * Vector3d(-0.086, 0, -0.003));
    return Pose{X_WO.p + tab - below * Vector3d::UnitZ(), q};
  };
  arm.Close();
  Pose before = under(0, 0.03);
  before.p -= 0.06 * ahead;
  arm.SwingTo(before, 2);
  arm.MoveTo(under(0, 0.012), 1);
  for (int i = 0; i <= 800; ++i) arm.Follow(under(angle * i / 800, 0.012));
  Pose back = under(angle, 0.012);
  back.p -= 0.12 * ahead;
  arm.MoveTo(back, 1.2);
}

// How a cup that lies in the gripper as X_GC can be poured over the bowl: turned about a horizontal axis through it, 46 mm
// above the rim and 22 mm aside.
struct PourPath {
  static constexpr double kAngle = 125 * M_PI / 180;
  Vector3d bowl;
  Pose X_GC;
  double yaw = 0, side = 1;
  double room = -1;  // ScriptedArm::Room

  Pose At(double angle) const {
    const Eigen::Quaterniond level = ExpSO3({0, 0, yaw});
    const Vector3d pivot = bowl + Vector3d(0, 0, 0.052 + 0.046) - side * 0.022 * (level * Vector3d::UnitY());
    const Eigen::Quaterniond q = ExpSO3(-side * angle * (level * Vector3d::UnitX())) * level;
    return Pose{pivot - q * Vector3d(0, 0, 0.045), q} * X_GC.Inverse();
  }
};

inline PourPath BestPour(const World& world, const ScriptedArm& arm, const Pose& X_GC) {
  PourPath best;
  const Vector3d bowl = world.Objects()[1].X_WO.p;
  for (const double turn : {0, -20, 20, -40, 40}) {
    for (const double side : {1, -1}) {
      PourPath path{bowl, X_GC, std::atan2(bowl.y(), bowl.x()) + turn * M_PI / 180, side};
      std::vector<Pose> poses;
      for (int i = 0; i <= 25; ++i) poses.push_back(path.At(PourPath::kAngle * i / 25));
      path.room = arm.Room(poses);
      if (path.room > best.room) best = path;
    }
  }
  return best;
}

// Takes the cup, of the two ways the one that can be poured better; returns where it lies in the gripper.
inline Pose LiftCup(World& world, ScriptedArm& arm) {
  const Pose X_WC = world.Objects()[0].X_WO;
  Pose grasp{X_WC * Vector3d(-0.055, 0, 0.050),
             Ahead(X_WC.q * Vector3d::UnitX(), X_WC.q * Vector3d::UnitY(), 25 * M_PI / 180)};
  const Pose flipped{grasp.p, grasp.q * Eigen::Quaterniond(0, 0, 0, 1)};
  if (BestPour(world, arm, flipped.Inverse() * X_WC).room > BestPour(world, arm, grasp.Inverse() * X_WC).room) {
    grasp = flipped;
  }
  arm.SwingTo({grasp.p - 0.06 * (grasp.q * Vector3d::UnitZ()), grasp.q}, 2);
  arm.MoveTo(grasp, 1);
  arm.Close();
  arm.MoveTo(ScriptedArm::Above(grasp, 0.12), 1.2);
  return grasp.Inverse() * X_WC;
}

// Pours, and turns the cup back by the share `back`.
inline void Pour(World& world, ScriptedArm& arm, const Pose& X_GC, double back = 1) {
  const PourPath path = BestPour(world, arm, X_GC);
  if (path.room < 0) throw std::runtime_error("the arm cannot pour there");
  const auto at = [&](double share) { return path.At(PourPath::kAngle * share); };
  arm.SwingTo(at(0), 2.5);
  for (int i = 1; i <= 750; ++i) arm.Follow(at(ScriptedArm::MinimumJerk(i / 750.)));
  arm.Hold(1);
  for (int i = 1; i <= 375; ++i) arm.Follow(at(1 - back * ScriptedArm::MinimumJerk(i / 375.)));
  arm.Hold(0.3);
}

// Puts the cup, held upright, down where its axis meets the table at p_W.
inline void PutCup(ScriptedArm& arm, const Pose& X_GC, const Vector3d& p_W) {
  const Pose place = Pose{p_W, ExpSO3({0, 0, std::atan2(p_W.y(), p_W.x())})} * X_GC.Inverse();
  arm.SwingTo(ScriptedArm::Above(place, 0.10), 2);
  arm.MoveTo(ScriptedArm::Above(place, 0.001), 1.2);
  arm.Open();
  arm.MoveTo({place.p - 0.08 * (place.q * Vector3d::UnitZ()), place.q}, 1);
}

inline void Stir(World& world, ScriptedArm& arm, double turns) {
  constexpr double kRadius = 0.022;
  const Pose X_WS = world.Objects()[2].X_WO;
  const Pose grasp{X_WS.p, Pointing(-Vector3d::UnitZ(), X_WS.q * Vector3d::UnitY())};
  arm.SwingTo(ScriptedArm::Above(grasp, 0.06), 1.5);
  arm.MoveTo(grasp, 0.8);
  arm.Close();
  arm.MoveTo(ScriptedArm::Above(grasp, 0.085), 1);
  const Vector3d centre = world.Objects()[1].X_WO.p + Vector3d(0, 0, 0.014 + 0.086);
  const auto at = [&](double angle) {
    return Pose{centre + kRadius * Vector3d(std::cos(angle), std::sin(angle), 0), grasp.q};
  };
  arm.MoveTo(ScriptedArm::Above(at(0), 0.06), 1.5);
  arm.MoveTo(at(0), 1);
  const int ticks = static_cast<int>(turns * 400);
  for (int i = 1; i <= ticks; ++i) arm.Follow(at(2 * M_PI * turns * i / ticks));
  arm.MoveTo(ScriptedArm::Above(at(2 * M_PI * turns), 0.07), 1);
}

}  // namespace intabs::test
