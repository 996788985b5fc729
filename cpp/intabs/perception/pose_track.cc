#include "intabs/perception/pose_track.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>

namespace intabs {
namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();

// White acceleration: 5 m/s^2 and 30 rad/s^2 for a tenth of a second, as hands and arms do it; the noise of
// one step of 40 ms is 7 mm and 2.5 deg.
constexpr double kAcceleration = 2.5;  // m^2/s^3
constexpr double kTurning = 90;        // rad^2/s^3
// Of a branch whose motion is not known yet.
constexpr double kSpeed = 1.0;     // m/s
constexpr double kTurnRate = 4.0;  // rad/s
// On top of a pose's own covariance: what errors in a row have in common must not look like motion.
constexpr double kSigmaP = 1e-3;  // m
constexpr double kSigmaR = 1e-2;  // rad
constexpr double kMaxGap = 0.5;   // s

// Minus log density of a pose anywhere within about a cubic metre and all rotations.
constexpr double kAnywhere = 4.4;
constexpr double kOutlier = 4.6;  // one frame in a hundred
// A story that starts anew beats one of outliers in the third frame that agrees.
constexpr double kBirth = 24;
// Neighbouring frames err alike: what one frame's pictures say counts for so much, and no more than this.
constexpr double kTemper = 0.5;
constexpr double kMaxFrameCost = 8;
constexpr double kDrop = 60;  // dearer branches than the best by so much are given up
constexpr size_t kBranches = 8;

}  // namespace

PoseTrack::Branch PoseTrack::Born(const ObjectPose& pose, double cost) {
  Branch b;
  b.X_WO = pose.X_WO;
  b.rate.setZero();
  b.P.setZero();
  b.P.topLeftCorner<6, 6>() = pose.covariance;
  b.P.diagonal().head<3>().array() += kSigmaR * kSigmaR;
  b.P.diagonal().segment<3>(3).array() += kSigmaP * kSigmaP;
  b.P.diagonal().segment<3>(6).array() = kTurnRate * kTurnRate;
  b.P.diagonal().tail<3>().array() = kSpeed * kSpeed;
  b.cost = cost + kBirth + kAnywhere;
  return b;
}

PoseTrack::Evidence PoseTrack::Update(double time_s, std::span<const ObjectPose> hypotheses) {
  if (hypotheses.empty()) return {};
  Predict(time_s);
  return Correct(hypotheses);
}

std::optional<Pose> PoseTrack::Predicted(double time_s) const {
  if (branches_.empty() || time_s - time_s_ > kMaxGap) return {};
  const Branch& b = branches_.front();
  const double dt = time_s - time_s_;
  return Pose{b.X_WO.p + dt * b.rate.tail<3>(), (ExpSO3(dt * b.rate.head<3>()) * b.X_WO.q).normalized()};
}

// Where the branches would be by now.
void PoseTrack::Predict(double time_s) {
  if (!branches_.empty() && time_s - time_s_ > kMaxGap) branches_.clear();
  const double dt = branches_.empty() ? 0 : time_s - time_s_;
  time_s_ = time_s;
  for (Branch& b : branches_) {
    b.X_WO.p += dt * b.rate.tail<3>();
    b.X_WO.q = (ExpSO3(dt * b.rate.head<3>()) * b.X_WO.q).normalized();
    Matrix12d F = Matrix12d::Identity();
    F.topRightCorner<6, 6>().diagonal().setConstant(dt);
    b.P = (F * b.P * F.transpose()).eval();
    for (int i = 0; i < 6; ++i) {
      const double q = i < 3 ? kTurning : kAcceleration;
      b.P(i, i) += q * dt * dt * dt / 3;
      b.P(i, i + 6) += q * dt * dt / 2;
      b.P(i + 6, i) += q * dt * dt / 2;
      b.P(i + 6, i + 6) += q * dt;
    }
    b.before = b.now;
    b.anew = false;
  }
}

PoseTrack::Evidence PoseTrack::Correct(std::span<const ObjectPose> hypotheses) {
  Evidence out;
  double least = kInfinity, stories = branches_.empty() ? 0 : kInfinity;
  for (const ObjectPose& h : hypotheses) least = std::min(least, h.cost);
  for (const Branch& b : branches_) stories = std::min(stories, b.cost);
  std::vector<Branch> next;
  for (int i = 0; i < static_cast<int>(hypotheses.size()); ++i) {
    const ObjectPose& h = hypotheses[i];
    const double picture = std::min(kTemper * (h.cost - least), kMaxFrameCost);
    Matrix6d R = h.covariance;
    R.diagonal().head<3>().array() += kSigmaR * kSigmaR;
    R.diagonal().tail<3>().array() += kSigmaP * kSigmaP;
    for (const Branch& b : branches_) {
      Vector6d e;
      e << LogSO3(h.X_WO.q * b.X_WO.q.conjugate()), h.X_WO.p - b.X_WO.p;
      const Eigen::LLT<Matrix6d> S(b.P.topLeftCorner<6, 6>() + R);
      const Vector6d white = S.matrixL().solve(e);
      const double log_root_det = S.matrixLLT().diagonal().array().log().sum();
      Branch n = b;
      n.cost += picture + 0.5 * white.squaredNorm() + log_root_det + 3 * std::log(2 * M_PI);
      if (!(n.cost < stories + kDrop + kOutlier + kAnywhere)) continue;
      const Eigen::Matrix<double, 12, 6> K = S.solve(b.P.topRows<6>()).transpose();
      const Eigen::Matrix<double, 12, 1> d = K * e;
      n.X_WO.p += d.segment<3>(3);
      n.X_WO.q = (ExpSO3(d.head<3>()) * b.X_WO.q).normalized();
      n.rate += d.tail<6>();
      n.P -= K * b.P.topRows<6>();
      n.P = (0.5 * (n.P + n.P.transpose())).eval();
      n.now = i;
      next.push_back(n);
    }
    Branch born = Born(h, stories + picture);
    born.now = i;
    born.anew = true;
    next.push_back(born);
  }
  for (Branch b : branches_) {
    b.cost += kOutlier + kAnywhere;
    b.now = -1;
    next.push_back(b);
  }

  // Stories that agree on this frame and the one before are one from now on.
  std::stable_sort(next.begin(), next.end(),
                   [](const Branch& a, const Branch& b) { return a.cost < b.cost; });
  const double best = next.front().cost;
  out.continues = !next.front().anew;
  out.cost.assign(hypotheses.size(), kInfinity);
  out.none = branches_.empty() ? kBirth : kInfinity;
  branches_.clear();
  for (Branch& b : next) {
    double& cost = b.now >= 0 ? out.cost[b.now] : out.none;
    cost = std::min(cost, b.cost - best);
    const bool known = std::any_of(branches_.begin(), branches_.end(), [&](const Branch& k) {
      return k.now == b.now && k.before == b.before && b.now >= 0;
    });
    if (known || branches_.size() >= kBranches || b.cost - best > kDrop) continue;
    branches_.push_back(b);
    branches_.back().cost -= best;
  }
  return out;
}

// How badly a story up to here and one from here on fit together; at worst it starts afresh.
double PoseTrack::Junction(const Branch& forward, const Branch& backward) {
  Eigen::Matrix<double, 12, 1> e;
  e << LogSO3(backward.X_WO.q * forward.X_WO.q.conjugate()), backward.X_WO.p - forward.X_WO.p,
      -backward.rate - forward.rate;
  Matrix12d P = backward.P;  // its time runs the other way
  P.topRightCorner<6, 6>() *= -1;
  P.bottomLeftCorner<6, 6>() *= -1;
  const Eigen::LLT<Matrix12d> S(forward.P + P);
  const double cost = 0.5 * S.matrixL().solve(e).squaredNorm() +
                      S.matrixLLT().diagonal().array().log().sum() + 6 * std::log(2 * M_PI);
  return std::min(cost, kBirth + kAnywhere);
}

std::vector<PoseTrack::Evidence> PoseTrack::Revise(std::span<const double> time_s,
                                                   std::span<const std::vector<ObjectPose>> hypotheses) {
  const size_t n = time_s.size();
  std::vector<Evidence> out(n);
  std::vector<std::vector<Branch>> stories(n);
  std::vector<bool> begins(n, false);
  PoseTrack forward, backward;
  for (size_t t = 0; t < n; ++t) {
    if (hypotheses[t].empty()) continue;
    forward.Predict(time_s[t]);
    begins[t] = forward.branches_.empty();
    out[t] = forward.Correct(hypotheses[t]);
    stories[t] = forward.branches_;
  }
  for (size_t t = n; t-- > 0;) {
    Evidence& e = out[t];
    if (e.empty()) continue;
    backward.Predict(-time_s[t]);
    if (!backward.branches_.empty()) {
      std::fill(e.cost.begin(), e.cost.end(), kInfinity);
      e.none = kInfinity;
      if (begins[t]) {  // no story leads here; those from here on may begin a frame later
        for (const Branch& b : backward.branches_) e.none = std::min(e.none, b.cost + kBirth);
      }
      for (const Branch& f : stories[t]) {
        double& cost = f.now >= 0 ? e.cost[f.now] : e.none;
        for (const Branch& b : backward.branches_) {
          cost = std::min(cost, f.cost + b.cost + Junction(f, b));
        }
      }
      double best = e.none;
      for (double c : e.cost) best = std::min(best, c);
      for (double& c : e.cost) c -= best;
      e.none -= best;
      e.continues = true;
    }
    backward.Correct(hypotheses[t]);
  }
  return out;
}

Verdict Judge(const PoseTrack::Evidence& evidence) {
  Verdict out;
  if (evidence.empty()) return out;
  const auto best = std::min_element(evidence.cost.begin(), evidence.cost.end());
  if (evidence.none < *best) return out;
  out.hypothesis = static_cast<int>(best - evidence.cost.begin());
  double others = std::exp(*best - evidence.none);
  for (size_t i = 0; i < evidence.cost.size(); ++i) {
    if (static_cast<int>(i) != out.hypothesis) others += std::exp(*best - evidence.cost[i]);
  }
  out.p_wrong = others / (1 + others);
  return out;
}

}  // namespace intabs
