#include "intabs/kinematics/ik.h"

#include <Eigen/Cholesky>
#include <Eigen/SVD>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <numbers>
#include <random>

namespace intabs {
namespace {

constexpr double kPi = std::numbers::pi;

// Nominal lengths of the Lite 6 [m]: shoulder above the base, shoulder to elbow, elbow to wrist (forward and
// down at q = 0), wrist to flange.
constexpr double kShoulder = 0.2435, kUpper = 0.2002, kForward = 0.087, kDown = 0.22761, kWrist = 0.0625;
// How far beyond the nominal arm's reach or limits a calibrated arm may still get.
constexpr double kReachSlack = 0.02;  // [m]
constexpr double kLimitSlack = 0.05;  // [rad]
constexpr int kSearches = 16;
// Below this |q5| axes 4 and 6 are one: turning about either costs less than the tolerance.
constexpr double kWristSingular = 5e-5;  // [rad]

struct Branches {
  int n = 0;
  std::array<JointVector, 8> q;
  double reach = 0;  // from the shoulder to the wanted wrist [m]
};

double Wrap(double angle) { return std::remainder(angle, 2 * kPi); }

// All q in (-pi, pi] (q3: in its own range) of the nominal arm for the flange pose, joint limits not looked
// at. Where the answer is a free choice (wrist above the shoulder, or straight), the seed's value is taken.
Branches ClosedForm(const Pose& X_BE, const JointVector& q_seed) {
  Branches out;
  const Eigen::Matrix3d R_BE = X_BE.q.toRotationMatrix();
  const Eigen::Vector3d wrist = X_BE.p - kWrist * R_BE.col(2) - Eigen::Vector3d(0, 0, kShoulder);
  const double radius = std::hypot(wrist.x(), wrist.y());
  out.reach = wrist.norm();
  const double forearm = std::hypot(kForward, kDown);
  const double bend = kPi / 2 + std::atan2(kDown, kForward);  // q3 at which the arm is straight
  const double c = (out.reach * out.reach - kUpper * kUpper - forearm * forearm) / (2 * kUpper * forearm);
  if (out.reach > kUpper + forearm + kReachSlack || out.reach < forearm - kUpper - kReachSlack) return out;
  const double elbow = std::acos(std::clamp(c, -1.0, 1.0));

  for (int side = 0; side < 2; ++side) {  // facing the wrist, or with the back to it
    double q1 = radius > 1e-9 ? std::atan2(wrist.y(), wrist.x()) : q_seed[0];
    if (side == 1) q1 += kPi;
    const double x = side == 0 ? radius : -radius;
    for (const double gamma : {elbow, -elbow}) {
      // Angles in the arm's plane: the upper arm stands at pi/2 - q2, the forearm gamma further.
      const double upper = std::atan2(wrist.z(), x) -
                           std::atan2(forearm * std::sin(gamma), kUpper + forearm * std::cos(gamma));
      JointVector q = JointVector::Zero();
      q[0] = Wrap(q1);
      q[1] = Wrap(kPi / 2 - upper);
      q[2] = Wrap(gamma + bend - kPi) + kPi;
      if (q[2] > 1.5 * kPi + 0.7) q[2] -= 2 * kPi;  // q3 goes from -3.5 to 300 degrees
      // R_BE = Rz(q1) Ry(q2 - q3) Rx(pi) M, where the wrist turns M = Rz(q4) Ry(-q5) Rz(q6).
      const Eigen::Quaterniond q_forearm = Eigen::AngleAxisd(q[0], Eigen::Vector3d::UnitZ()) *
                                           Eigen::AngleAxisd(q[1] - q[2], Eigen::Vector3d::UnitY()) *
                                           Eigen::AngleAxisd(kPi, Eigen::Vector3d::UnitX());
      const Eigen::Matrix3d M = q_forearm.toRotationMatrix().transpose() * R_BE;
      const double s = std::hypot(M(0, 2), M(1, 2));
      for (const double sign : {-1.0, 1.0}) {  // of q5
        q[4] = sign * std::atan2(s, M(2, 2));
        if (s > kWristSingular) {
          q[3] = std::atan2(-sign * M(1, 2), -sign * M(0, 2));
          q[5] = std::atan2(-sign * M(2, 1), sign * M(2, 0));
        } else {
          q[3] = Wrap(q_seed[3]);
          q[5] = Wrap(std::atan2(M(1, 0), M(0, 0)) - q[3]);
        }
        out.q[out.n++] = q;
      }
    }
  }
  return out;
}

double Margin(const ArmModel& m, const JointVector& q) {
  return std::min((q - m.q_min()).minCoeff(), (m.q_max() - q).minCoeff());
}

double SmallestSingularValue(const ArmModel& model, const JointVector& q) {
  return Eigen::JacobiSVD<ArmJacobian>(model.Jacobian(q)).singularValues()[kNumJoints - 1];
}

// Position error [m] and rotation vector [rad] from the pose at q to the wanted one, in B.
Eigen::Matrix<double, 6, 1> Error(const Pose& X_wanted, const Pose& X) {
  Eigen::Matrix<double, 6, 1> e;
  e << X_wanted.p - X.p, LogSO3(X_wanted.q * X.q.conjugate());
  return e;
}

bool WithinTolerance(const Eigen::Matrix<double, 6, 1>& e) {
  return e.head<3>().norm() <= IkSolver::kPositionTolerance &&
         e.tail<3>().norm() <= IkSolver::kAngleTolerance;
}

// Levenberg-Marquardt from q, kept within the limits. True if q then gives the wanted pose.
bool Polish(const ArmModel& model, const Pose& X_wanted, JointVector& q) {
  q = q.cwiseMax(model.q_min()).cwiseMin(model.q_max());
  Pose X;
  ArmJacobian J = model.TipAndJacobian(q, X);
  Eigen::Matrix<double, 6, 1> e = Error(X_wanted, X);
  double damping = 1e-3;  // times |e|^2: quadratic convergence where the Jacobian is regular
  for (int i = 0; i < 50 && e.norm() > 1e-10 && damping < 1e9; ++i) {
    const Eigen::Matrix<double, 6, 6> H =
        J.transpose() * J + damping * e.squaredNorm() * Eigen::Matrix<double, 6, 6>::Identity();
    const JointVector next =
        (q + JointVector(H.ldlt().solve(J.transpose() * e))).cwiseMax(model.q_min()).cwiseMin(model.q_max());
    Pose X_next;
    const ArmJacobian J_next = model.TipAndJacobian(next, X_next);
    const Eigen::Matrix<double, 6, 1> e_next = Error(X_wanted, X_next);
    if (next.allFinite() && e_next.norm() < e.norm()) {
      q = next;
      J = J_next;
      e = e_next;
      damping = std::max(damping * 0.1, 1e-6);
    } else {
      damping *= 10;
    }
  }
  return WithinTolerance(e);
}

std::string Text(const char* format, auto... values) {
  char text[160];
  std::snprintf(text, sizeof(text), format, values...);
  return text;
}

}  // namespace

double ArmScore(const ArmModel& model, const JointVector& q) {
  return std::min(Margin(model, q), 5 * SmallestSingularValue(model, q));
}

IkResult IkSolver::Solve(const Pose& X_wanted, const JointVector& q_seed, IkChoice choice) const {
  IkResult result;
  if (!X_wanted.IsFinite() || !q_seed.allFinite()) {
    result.why = "the wanted pose or the seed is not finite";
    return result;
  }
  if (std::abs(X_wanted.q.norm() - 1) > 1e-3) {
    result.why = Text("the wanted pose's quaternion has norm %.4g, it must be 1", X_wanted.q.norm());
    return result;
  }
  const Pose X_BG{X_wanted.p, X_wanted.q.normalized()};
  const Branches branches = ClosedForm(X_BG * model_.parameters().X_EG.Inverse(), q_seed);
  if (branches.n == 0) {
    result.why =
        Text("out of reach: the wrist would be %.3f m from the shoulder, the arm spans %.3f to %.3f m",
             branches.reach, std::hypot(kForward, kDown) - kUpper, std::hypot(kForward, kDown) + kUpper);
    return result;
  }

  // Every branch with every whole turn that the limits allow.
  struct Candidate {
    JointVector q;
    double score;     // in steps of 1e-6: what differs by less is equal
    double distance;  // squared
  };
  std::array<Candidate, 8 * 27> candidates;
  int n = 0;
  for (int b = 0; b < branches.n; ++b) {
    const double singular =
        choice == IkChoice::kBestScore ? 5 * SmallestSingularValue(model_, branches.q[b]) : 0;
    JointVector q = branches.q[b];
    for (const double t1 : {0.0, -2 * kPi, 2 * kPi}) {
      q[0] = branches.q[b][0] + t1;
      for (const double t4 : {0.0, -2 * kPi, 2 * kPi}) {
        q[3] = branches.q[b][3] + t4;
        for (const double t6 : {0.0, -2 * kPi, 2 * kPi}) {
          q[5] = branches.q[b][5] + t6;
          const double margin = Margin(model_, q);
          if (margin < -kLimitSlack) continue;
          candidates[n++] = {q, std::round(1e6 * std::min(margin, singular)), (q - q_seed).squaredNorm()};
        }
      }
    }
  }
  if (n == 0) {
    result.why = "reachable only outside the joint limits";
    return result;
  }
  std::sort(candidates.begin(), candidates.begin() + n, [choice](const Candidate& a, const Candidate& b) {
    if (choice == IkChoice::kBestScore && a.score != b.score) return a.score > b.score;
    return a.distance < b.distance;
  });
  for (int i = 0; i < n && !result.ok; ++i) {
    result.q = candidates[i].q;
    result.ok = Polish(model_, X_BG, result.q);
  }
  // A calibrated arm whose wrist stands above its shoulder may be far from every nominal branch: search.
  std::mt19937 random(1);  // always the same: equal questions have equal answers
  for (int k = 0; k < kSearches && !result.ok; ++k) {
    for (int i = 0; i < kNumJoints; ++i) {
      result.q[i] = std::uniform_real_distribution<double>(model_.q_min()[i], model_.q_max()[i])(random);
    }
    if (k == 0) result.q = q_seed;
    result.ok = Polish(model_, X_BG, result.q);
    for (const int i : {0, 3, 5}) {  // the whole turn nearest to the seed
      const double turned = q_seed[i] + Wrap(result.q[i] - q_seed[i]);
      if (turned > model_.q_min()[i] && turned < model_.q_max()[i]) result.q[i] = turned;
    }
  }
  if (result.ok) {
    result.score = ArmScore(model_, result.q);
    return result;
  }
  result.q.setZero();
  result.why = Text("out of reach or outside the joint limits: the wrist would be %.3f m from the shoulder",
                    branches.reach);
  return result;
}

}  // namespace intabs
