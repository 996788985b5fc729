#include "intabs/perception/gaps.h"

#include <Eigen/LU>
#include <cmath>
#include <stdexcept>
#include <string>
#include <vector>

namespace intabs {
namespace {

using State = Eigen::Matrix3d;  // rows: position, velocity, acceleration; columns: x, y, z

struct Sample {
  double time;
  Eigen::Vector3d p;
  bool measured;
  double sigma;  // out
};

// White jerk over dt: transition and process noise of (p, v, a) of one axis (Bar-Shalom, Li, Kirubarajan,
// "Estimation with Applications to Tracking and Navigation", 2001, 6.2.3).
void Motion(double dt, double density, Eigen::Matrix3d& F, Eigen::Matrix3d& Q) {
  const double d2 = dt * dt, d3 = d2 * dt, d4 = d3 * dt, d5 = d4 * dt;
  F << 1, dt, d2 / 2, 0, 1, dt, 0, 0, 1;
  Q << d5 / 20, d4 / 8, d3 / 6, d4 / 8, d3 / 3, d2 / 2, d3 / 6, d2 / 2, dt;
  Q *= density;
}

// run: first and last sample are measured.
void Smooth(std::span<Sample> run, const GapOptions& options) {
  struct Step {
    State x, x_predicted;
    Eigen::Matrix3d P, P_predicted, F;
  };
  std::vector<Step> steps(run.size());
  const double r2 = options.sigma * options.sigma;
  for (size_t k = 0; k < run.size(); ++k) {
    Step& s = steps[k];
    if (k == 0) {
      s.F.setIdentity();
      s.x_predicted.setZero();
      s.x_predicted.row(0) = run[0].p;
      s.P_predicted = Eigen::Vector3d(100 * r2, 1.0, 25.0).asDiagonal();  // a hand's speed and acceleration
    } else {
      Eigen::Matrix3d Q;
      Motion(run[k].time - run[k - 1].time, options.jerk_density, s.F, Q);
      s.x_predicted = s.F * steps[k - 1].x;
      s.P_predicted = s.F * steps[k - 1].P * s.F.transpose() + Q;
    }
    s.x = s.x_predicted;
    s.P = s.P_predicted;
    if (!run[k].measured) continue;
    const Eigen::Vector3d gain = s.P_predicted.col(0) / (s.P_predicted(0, 0) + r2);
    s.x += gain * (run[k].p.transpose() - s.x_predicted.row(0));
    Eigen::Matrix3d A = Eigen::Matrix3d::Identity();  // Joseph's form stays positive
    A.col(0) -= gain;
    s.P = A * s.P_predicted * A.transpose() + r2 * gain * gain.transpose();
  }
  // Rauch, Tung, Striebel, AIAA Journal 3(8), 1965.
  State x = steps.back().x;
  Eigen::Matrix3d P = steps.back().P;
  for (size_t k = run.size(); k-- > 0;) {
    if (k + 1 < run.size()) {
      const Step& next = steps[k + 1];
      const Eigen::Matrix3d G = steps[k].P * next.F.transpose() * next.P_predicted.inverse();
      x = steps[k].x + G * (x - next.x_predicted);
      P = steps[k].P + G * (P - next.P_predicted) * G.transpose();
    }
    run[k].sigma = run[k].measured ? options.sigma : std::sqrt(std::max(P(0, 0), 0.0));
    if (!run[k].measured) run[k].p = x.row(0);
  }
}

void Interpolate(std::span<Sample> run, const GapOptions& options) {
  size_t before = 0;
  for (size_t after = 1; after < run.size(); ++after) {
    if (!run[after].measured) continue;
    for (size_t k = before + 1; k < after; ++k) {
      const double s = (run[k].time - run[before].time) / (run[after].time - run[before].time);
      run[k].p = (1 - s) * run[before].p + s * run[after].p;
    }
    before = after;
  }
  for (Sample& sample : run) sample.sigma = options.sigma;
}

[[noreturn]] void Refuse(const std::string& what) { throw std::invalid_argument("gaps: " + what); }

void CheckSizes(std::span<const double> time, size_t values, size_t states, size_t sigmas) {
  if (values != time.size() || states != time.size() || (sigmas != 0 && sigmas != time.size())) {
    Refuse(std::to_string(time.size()) + " times for " + std::to_string(values) + " values and " +
           std::to_string(states) + " states");
  }
  for (size_t k = 0; k < time.size(); ++k) {
    if (!std::isfinite(time[k]) || (k > 0 && time[k] <= time[k - 1])) {
      Refuse("time does not rise at sample " + std::to_string(k));
    }
  }
}

// Fills the positions, marks what is filled, calls turn(before, after) for each gap. A run ends where max_gap
// is passed: what lies beyond says nothing of this side.
template <class Turn>
void Fill(std::vector<Sample>& samples, std::span<SampleState> state, const GapOptions& options,
          Turn&& turn) {
  const size_t n = samples.size();
  size_t first = 0;
  while (first < n && !samples[first].measured) ++first;
  while (first < n) {
    size_t last = first;
    for (size_t k = first + 1; k < n; ++k) {
      if (samples[k].time - samples[last].time > options.max_gap * (1 + 1e-9)) break;
      if (samples[k].measured) last = k;
    }
    const std::span run(&samples[first], last - first + 1);
    if (options.method == GapMethod::kKalman) {
      Smooth(run, options);
    } else {
      Interpolate(run, options);
    }
    for (size_t before = first, k = first + 1; k <= last; ++k) {
      if (!samples[k].measured) {
        state[k] = SampleState::kFilled;
        continue;
      }
      if (k > before + 1) turn(first, before, k, last);
      before = k;
    }
    for (first = last + 1; first < n && !samples[first].measured;) ++first;
  }
}

// Turning rate of X at sample `at` [rad/s, in X's own axes]: slope at the end of a parabola through the
// rotations of the measured samples from `at` on, in direction `step`, up to `end`. False with fewer than
// three samples.
bool TurningRate(std::span<const double> time, std::span<const Pose> pose, std::span<const SampleState> state,
                 size_t at, size_t end, int step, Eigen::Vector3d& rate) {
  constexpr double kWindow = 0.3;  // s
  Eigen::Matrix2d A = Eigen::Matrix2d::Zero();
  Eigen::Matrix<double, 2, 3> b = Eigen::Matrix<double, 2, 3>::Zero();
  int n = 0;
  // The parabola goes through the sample itself: the gap's curve starts there.
  for (size_t k = at;; k += step) {
    const double t = time[k] - time[at];
    if (std::abs(t) > kWindow) break;
    if (k != at && state[k] == SampleState::kMeasured) {
      const Eigen::Vector2d row(t, t * t);
      A += row * row.transpose();
      b += row * LogSO3(pose[at].q.conjugate() * pose[k].q).transpose();
      ++n;
    }
    if (k == end) break;
  }
  if (n < 3) return false;
  rate = (A.inverse() * b).row(0).transpose();
  return rate.allFinite();
}

// Inverse of the right Jacobian of SO(3) (Chirikjian, "Stochastic Models, Information Theory, and Lie
// Groups", vol. 2, 2011, 10.86): rate of the rotation vector f by the body's angular velocity.
Eigen::Matrix3d InverseRightJacobian(const Eigen::Vector3d& f) {
  const double a = f.norm();
  const double k = a > 1e-4 ? 1 / (a * a) - (1 + std::cos(a)) / (2 * a * std::sin(a)) : 1.0 / 12;
  Eigen::Matrix3d S;
  S << 0, -f.z(), f.y(), f.z(), 0, -f.x(), -f.y(), f.x(), 0;
  return Eigen::Matrix3d::Identity() + 0.5 * S + k * S * S;
}

}  // namespace

void FillGaps(std::span<const double> time, std::span<Pose> pose, std::span<SampleState> state,
              const GapOptions& options, std::span<double> sigma) {
  CheckSizes(time, pose.size(), state.size(), sigma.size());
  std::vector<Sample> samples(time.size());
  for (size_t k = 0; k < time.size(); ++k) {
    const bool measured = state[k] == SampleState::kMeasured;
    if (!measured) state[k] = SampleState::kInvalid;
    if (measured && (!pose[k].IsFinite() || std::abs(pose[k].q.norm() - 1) > 1e-3)) {
      Refuse("pose " + std::to_string(k) + " is said to be measured, but is not finite or not of unit norm");
    }
    samples[k] = {time[k], pose[k].p, measured, 0};
  }
  Fill(samples, state, options, [&](size_t first, size_t before, size_t after, size_t last) {
    const Eigen::Quaterniond q0 = pose[before].q;
    const Eigen::Vector3d turn = LogSO3(q0.conjugate() * pose[after].q);
    const double gap = time[after] - time[before];
    // Near half a turn the direction is anybody's guess, and rates do not help.
    const bool cubic =
        options.method == GapMethod::kKalman && gap > options.slerp_gap * (1 + 1e-9) && turn.norm() < 2.5;
    Eigen::Vector3d start = turn / gap, end = turn / gap, rate;
    if (cubic) {
      if (TurningRate(time, pose, state, before, first, -1, rate)) start = rate;
      if (TurningRate(time, pose, state, after, last, +1, rate)) end = InverseRightJacobian(turn) * rate;
    }
    for (size_t k = before + 1; k < after; ++k) {
      const double s = (time[k] - time[before]) / gap;
      Eigen::Vector3d f = s * turn;
      if (cubic) {  // Hermite's cubic from 0 to turn
        f = s * s * (3 - 2 * s) * turn + gap * s * (1 - s) * ((1 - s) * start - s * end);
      }
      pose[k].q = (q0 * ExpSO3(f)).normalized();
    }
  });
  for (size_t k = 0; k < time.size(); ++k) {
    if (state[k] == SampleState::kFilled) pose[k].p = samples[k].p;
    if (!sigma.empty()) sigma[k] = samples[k].sigma;
  }
}

void FillPointGaps(std::span<const double> time, std::span<Eigen::Vector3d> point,
                   std::span<SampleState> state, const GapOptions& options, std::span<double> sigma) {
  CheckSizes(time, point.size(), state.size(), sigma.size());
  std::vector<Sample> samples(time.size());
  for (size_t k = 0; k < time.size(); ++k) {
    const bool measured = state[k] == SampleState::kMeasured;
    if (!measured) state[k] = SampleState::kInvalid;
    if (measured && !point[k].allFinite()) {
      Refuse("point " + std::to_string(k) + " is said to be measured, but is not finite");
    }
    samples[k] = {time[k], point[k], measured, 0};
  }
  Fill(samples, state, options, [](size_t, size_t, size_t, size_t) {});
  for (size_t k = 0; k < time.size(); ++k) {
    if (state[k] == SampleState::kFilled) point[k] = samples[k].p;
    if (!sigma.empty()) sigma[k] = samples[k].sigma;
  }
}

// Integrated Ornstein-Uhlenbeck process: the velocity's standard deviation stays speed_sigma.
void GapTracker::Axis::Advance(double dt, double decay, double speed_sigma) noexcept {
  const double keep = std::exp(-dt / decay);
  const double go = decay * (1 - keep);
  const double s2 = speed_sigma * speed_sigma;
  pp += 2 * go * pv + go * go * vv +
        s2 * decay * decay * std::max(0.0, 2 * dt / decay - 3 + 4 * keep - keep * keep);
  pv = keep * (pv + go * vv) + s2 * decay * (1 - keep) * (1 - keep);
  vv = keep * keep * vv + s2 * (1 - keep * keep);
}

void GapTracker::Advance(double dt, Pose& X, Eigen::Vector3d& v, Eigen::Vector3d& w, Axis& place,
                         Axis& turn) const noexcept {
  const double keep = std::exp(-dt / options_.decay);
  const double go = options_.decay * (1 - keep);
  X.p += go * v;
  X.q = (X.q * ExpSO3(go * w)).normalized();
  v *= keep;
  w *= keep;
  place.Advance(dt, options_.decay, options_.speed_sigma);
  turn.Advance(dt, options_.decay, options_.angular_speed_sigma);
}

bool GapTracker::Update(double time, const Pose& measured, double sigma, double sigma_angle) noexcept {
  if (!std::isfinite(time) || !measured.IsFinite() || std::abs(measured.q.norm() - 1) > 1e-3) return false;
  if (!(sigma > 0 && sigma_angle > 0)) return false;
  if (seen_ && time <= time_) return false;
  if (seen_ && time - time_ > options_.max_gap) seen_ = false;
  const double r2 = sigma * sigma, ra2 = sigma_angle * sigma_angle;
  if (!seen_) {
    X_ = measured;
    v_.setZero();
    w_.setZero();
    place_ = {r2, 0, options_.speed_sigma * options_.speed_sigma};
    turn_ = {ra2, 0, options_.angular_speed_sigma * options_.angular_speed_sigma};
  } else {
    Advance(time - time_, X_, v_, w_, place_, turn_);
    const auto correct = [](Axis& c, double r) {
      const double s = c.pp + r;
      const Eigen::Vector2d gain(c.pp / s, c.pv / s);
      c.vv -= gain[1] * c.pv;
      c.pv *= 1 - gain[0];
      c.pp *= 1 - gain[0];
      return gain;
    };
    const Eigen::Vector2d kp = correct(place_, r2), ka = correct(turn_, ra2);
    const Eigen::Vector3d dp = measured.p - X_.p;
    const Eigen::Vector3d da = LogSO3(X_.q.conjugate() * measured.q);
    X_.p += kp[0] * dp;
    v_ += kp[1] * dp;
    X_.q = (X_.q * ExpSO3(ka[0] * da)).normalized();
    w_ += ka[1] * da;
  }
  seen_ = true;
  time_ = time;
  return true;
}

GapEstimate GapTracker::Predict(double time) const noexcept {
  GapEstimate out;
  if (!seen_) return out;
  out.age = std::max(0.0, time - time_);
  out.pose = X_;
  Eigen::Vector3d v = v_, w = w_;
  Axis place = place_, turn = turn_;
  if (out.age > 0) Advance(out.age, out.pose, v, w, place, turn);
  out.sigma = std::sqrt(std::max(place.pp, 0.0));
  out.sigma_angle = std::sqrt(std::max(turn.pp, 0.0));
  out.valid = out.age <= options_.max_gap * (1 + 1e-9);
  return out;
}

}  // namespace intabs
