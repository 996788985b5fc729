// Drives a World's arm along straight lines of the tip, as a test's hand.
#pragma once

#include <algorithm>
#include <stdexcept>
#include <vector>

#include "intabs/kinematics/ik.h"
#include "intabs/plant/world.h"

namespace intabs::test {

class ScriptedArm {
 public:
  explicit ScriptedArm(World& world) : world_(world), q_(world.Arm().q) {}

  // Minimum-jerk timing; the joints follow by inverse kinematics at each tick.
  void MoveTo(const Pose& X_WG, double seconds) {
    const Pose from = ik_.model().Tip(q_);
    const int ticks = Ticks(seconds);
    for (int i = 1; i <= ticks; ++i) {
      const double s = MinimumJerk(static_cast<double>(i) / ticks);
      Follow({from.p + s * (X_WG.p - from.p), from.q.slerp(s, X_WG.q)});
    }
  }

  // One tick of a path.
  void Follow(const Pose& X_WG) { Step(Solve(X_WG, q_, IkChoice::kNearest)); }

  // Straight in the joints: the nearest way, unless it is uncomfortable there.
  void SwingTo(const Pose& X_WG, double seconds) {
    const JointVector from = q_, to = Solve(X_WG, q_, Choice(X_WG));
    const int ticks = Ticks(seconds);
    for (int i = 1; i <= ticks; ++i) Step(from + MinimumJerk(static_cast<double>(i) / ticks) * (to - from));
  }

  static double MinimumJerk(double t) { return t * t * t * (10 - 15 * t + 6 * t * t); }

  void Hold(double seconds) {
    for (int i = Ticks(seconds); i > 0; --i) world_.Step({q_, JointVector::Zero(), closed_});
  }

  void Close() { Grip(true); }
  void Open() { Grip(false); }

  Pose X_WG() const { return ik_.model().Tip(world_.Arm().q); }  // as measured

  // Takes the block, which stands, by its handle and lifts it.
  void PickBlock(double lift) {
    const Pose grasp = Grasp(world_.Objects()[0].X_WO);
    MoveTo(Above(grasp, 0.08), 1.5);
    MoveTo(grasp, 1.0);
    Close();
    MoveTo(Above(grasp, lift), 1.0);
  }

  // Where the tip is when it holds the block, here or elsewhere.
  Pose Grasp(const Pose& X_WO) const {
    // Pointing down, fingers on the handle's broad sides; of the two ways the one that turns the wrist less.
    Pose down{{0, 0, 0.034}, Eigen::Quaterniond(0, 1, 0, 0)},
        flipped{{0, 0, 0.034}, Eigen::Quaterniond(0, 0, 1, 0)};
    const Pose a = X_WO * down, b = X_WO * flipped, now = ik_.model().Tip(q_);
    return AngleBetween(a.q, now.q) < AngleBetween(b.q, now.q) ? a : b;
  }

  static Pose Above(Pose X, double height) {
    X.p.z() += height;
    return X;
  }

  // The least score along a path that begins with SwingTo; negative: impossible.
  double Room(const std::vector<Pose>& path) const {
    double room = 9;
    JointVector q = q_;
    for (size_t i = 0; i < path.size(); ++i) {
      const IkResult ik = ik_.Solve(path[i], q, i == 0 ? Choice(path[i]) : IkChoice::kNearest);
      if (!ik.ok || (i > 0 && (ik.q - q).cwiseAbs().maxCoeff() > 0.5)) return -1;
      q = ik.q;
      room = std::min(room, ik.score);
    }
    return room;
  }

 private:
  static constexpr double kTick = 1e-6 * kDriverPeriodUs;  // [s]

  IkChoice Choice(const Pose& X_WG) const {
    const IkResult nearest = ik_.Solve(X_WG, q_);
    return nearest.ok && nearest.score > 0.2 ? IkChoice::kNearest : IkChoice::kBestScore;
  }
  JointVector Solve(const Pose& X_WG, const JointVector& seed, IkChoice choice) const {
    const IkResult ik = ik_.Solve(X_WG, seed, choice);
    if (!ik.ok) throw std::runtime_error("the script asks for what the arm cannot: " + ik.why);
    return ik.q;
  }
  void Step(const JointVector& q) {
    world_.Step({q, (q - q_) / kTick, closed_});
    q_ = q;
  }
  static int Ticks(double seconds) { return static_cast<int>(seconds / kTick + 0.5); }
  void Grip(bool closed) {
    closed_ = closed;
    Hold(0.5);
  }

  World& world_;
  const IkSolver ik_{ArmModel::Lite6()};
  JointVector q_;
  bool closed_ = false;
};

}  // namespace intabs::test
