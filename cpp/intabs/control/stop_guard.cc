#include "intabs/control/stop_guard.h"

namespace intabs {
namespace {

using lite6_shape::kBoxes;
using lite6_shape::kCapsules;
using lite6_shape::kCylinders;
using lite6_shape::kPairs;

// Third derivative of the tip's place at full jerk of all joints, rounded up [m/s^3].
constexpr double kTipJerk = 1500;

}  // namespace

StopGuard::StopGuard(const ArmModel& model, const ArmSpace& space,
                     const std::array<AxisLimits, kNumJoints>& limits) noexcept
    : limits_(limits), space_(space) {
  const ArmParameters& a = model.parameters();
  for (int i = 0; i < kNumJoints; ++i) {
    const Eigen::Matrix3f R = a.X_PJ[i].q.toRotationMatrix().cast<float>();
    for (int r = 0; r < 3; ++r) {
      for (int c = 0; c < 3; ++c) X_PJ_[i].R[r][c] = R(r, c);
      X_PJ_[i].p[r] = static_cast<float>(a.X_PJ[i].p[r]);
    }
  }
  for (int r = 0; r < 3; ++r) p_EG_[r] = static_cast<float>(a.X_EG.p[r]);
}

void StopGuard::Reset(const JointVector& q) noexcept {
  std::array<Lanes, kNumJoints> at, still;
  for (int i = 0; i < kNumJoints; ++i) {
    at[i].setConstant(static_cast<float>(q[i]));
    still[i].setZero();
  }
  Evaluate(at, still);
  for (int i = 0; i < kNumClearances; ++i) floor_[i] = std::min(0.0f, now_[i]);
}

void StopGuard::Adopt() noexcept {
  for (int i = 0; i < kNumClearances; ++i) floor_[i] = std::max(floor_[i], std::min(0.0f, now_[i]));
}

bool StopGuard::Free(const AxisStates& s, double jerk_factor) noexcept {
  const auto change = [&](int i) {
    return SpeedChange(s[i].v, s[i].a, 0, limits_[i].a, jerk_factor * limits_[i].j);
  };
  static_assert(kNumJoints == 6);
  const std::array<SpeedChange, kNumJoints> stop = {change(0), change(1), change(2),
                                                    change(3), change(4), change(5)};
  double duration = 0;
  for (const SpeedChange& c : stop) duration = std::max(duration, c.duration());
  const double gap = duration / (kInstants - 1);
  const Lanes t = Lanes::LinSpaced(0.0f, static_cast<float>(duration));

  std::array<Lanes, kNumJoints> q, dq;
  for (int i = 0; i < kNumJoints; ++i) {
    const SpeedChange& c = stop[i];
    const auto jerk = static_cast<float>(c.jerk), t1 = static_cast<float>(c.t1),
               t2 = static_cast<float>(c.t2), t3 = static_cast<float>(c.t3);
    Lanes x = Lanes::Constant(static_cast<float>(s[i].x)), v = Lanes::Constant(static_cast<float>(s[i].v));
    const Lanes d1 = t.min(t1), d2 = (t - t1).max(0.0f).min(t2), d3 = (t - (t1 + t2)).max(0.0f).min(t3);
    const auto a0 = static_cast<float>(s[i].a);
    x += d1 * (v + d1 * (0.5f * a0 + d1 * (jerk / 6)));
    v += d1 * (a0 + d1 * (0.5f * jerk));
    const Lanes a = a0 + jerk * d1;
    x += d2 * (v + 0.5f * d2 * a);
    v += d2 * a;
    x += d3 * (v + d3 * (0.5f * a - d3 * (jerk / 6)));
    v += d3 * (a - d3 * (0.5f * jerk));
    q[i] = x;
    dq[i] = v;
  }
  Evaluate(q, dq);

  if (tip_speed_ > space_.tip_speed_guard - 0.002 - kTipJerk * gap * gap / 8) return false;
  for (int i = 0; i < kNumClearances; ++i) {
    if (least_[i] < floor_[i]) return false;
  }
  return true;
}

StopGuard::Vec StopGuard::Place(const Frame& f, const float* p) noexcept {
  return {f.p.x + f.axis[0].x * p[0] + f.axis[1].x * p[1] + f.axis[2].x * p[2],
          f.p.y + f.axis[0].y * p[0] + f.axis[1].y * p[1] + f.axis[2].y * p[2],
          f.p.z + f.axis[0].z * p[0] + f.axis[1].z * p[1] + f.axis[2].z * p[2]};
}

// Ericson, Real-Time Collision Detection (2005), 5.1.9, without branches; the segments have a length.
StopGuard::Lanes StopGuard::SegmentDistance(const Vec& p0, const Vec& p1, const Vec& q0,
                                            const Vec& q1) noexcept {
  const Vec u{p1.x - p0.x, p1.y - p0.y, p1.z - p0.z}, w{q1.x - q0.x, q1.y - q0.y, q1.z - q0.z},
      r{p0.x - q0.x, p0.y - q0.y, p0.z - q0.z};
  const auto dot = [](const Vec& a, const Vec& b) -> Lanes { return a.x * b.x + a.y * b.y + a.z * b.z; };
  const Lanes a = dot(u, u), e = dot(w, w), b = dot(u, w), c = dot(u, r), f = dot(w, r);
  Lanes s = ((b * f - c * e) / (a * e - b * b).max(1e-12f)).max(0.0f).min(1.0f);
  const Lanes t = ((b * s + f) / e).max(0.0f).min(1.0f);
  s = ((b * t - c) / a).max(0.0f).min(1.0f);
  const Vec d{r.x + s * u.x - t * w.x, r.y + s * u.y - t * w.y, r.z + s * u.z - t * w.z};
  return dot(d, d).sqrt();
}

void StopGuard::Evaluate(const std::array<Lanes, kNumJoints>& q,
                         const std::array<Lanes, kNumJoints>& dq) noexcept {
  // Frames of base and links.
  std::array<Frame, kNumJoints + 1> frames;
  frames[0] = {
      {Vec{Lanes::Ones(), Lanes::Zero(), Lanes::Zero()}, Vec{Lanes::Zero(), Lanes::Ones(), Lanes::Zero()},
       Vec{Lanes::Zero(), Lanes::Zero(), Lanes::Ones()}},
      Vec{Lanes::Zero(), Lanes::Zero(), Lanes::Zero()}};
  for (int i = 0; i < kNumJoints; ++i) {
    const Frame& before = frames[i];
    Frame& f = frames[i + 1];
    const Fixed& X = X_PJ_[i];
    f.p = Place(before, X.p);
    Vec column[3];
    for (int k = 0; k < 3; ++k) {
      const float r[3] = {X.R[0][k], X.R[1][k], X.R[2][k]};
      column[k] = {before.axis[0].x * r[0] + before.axis[1].x * r[1] + before.axis[2].x * r[2],
                   before.axis[0].y * r[0] + before.axis[1].y * r[1] + before.axis[2].y * r[2],
                   before.axis[0].z * r[0] + before.axis[1].z * r[1] + before.axis[2].z * r[2]};
    }
    const Lanes c = q[i].cos(), s = q[i].sin();
    f.axis[0] = {c * column[0].x + s * column[1].x, c * column[0].y + s * column[1].y,
                 c * column[0].z + s * column[1].z};
    f.axis[1] = {c * column[1].x - s * column[0].x, c * column[1].y - s * column[0].y,
                 c * column[1].z - s * column[0].z};
    f.axis[2] = column[2];
  }

  int n = 0;
  std::array<Vec, kCapsules.size()> p0, p1;
  for (size_t i = 0; i < kCapsules.size(); ++i) {
    p0[i] = Place(frames[kCapsules[i].link], kCapsules[i].p0);
    p1[i] = Place(frames[kCapsules[i].link], kCapsules[i].p1);
  }
  for (const auto& pair : kPairs) {
    const float radii =
        kCapsules[pair.a].radius + kCapsules[pair.b].radius + static_cast<float>(space_.self_margin);
    Keep(n++, SegmentDistance(p0[pair.a], p1[pair.a], p0[pair.b], p1[pair.b]) - radii);
  }

  // The lowest point of each body.
  const auto table = static_cast<float>(space_.table_z + space_.table_margin);
  const auto height = [&frames](int link, const float* p) -> Lanes {
    const Frame& f = frames[link];
    return f.p.z + f.axis[0].z * p[0] + f.axis[1].z * p[1] + f.axis[2].z * p[2];
  };
  for (const auto& c : kCylinders) {
    const Lanes z0 = height(c.link, c.p0), z1 = height(c.link, c.p1);
    const float dx = c.p1[0] - c.p0[0], dy = c.p1[1] - c.p0[1], dz = c.p1[2] - c.p0[2];
    const Lanes steep = (z1 - z0) * (1 / std::sqrt(dx * dx + dy * dy + dz * dz));
    Keep(n++, z0.min(z1) - c.radius * (1 - steep.square()).max(0.0f).sqrt() - table);
  }
  for (const auto& b : kBoxes) {
    const Frame& f = frames[b.link];
    Keep(n++, height(b.link, b.centre) - b.half[0] * f.axis[0].z.abs() - b.half[1] * f.axis[1].z.abs() -
                  b.half[2] * f.axis[2].z.abs() - table);
  }

  const Vec tip = Place(frames[kNumJoints], p_EG_);
  const auto bound = [](double v) { return static_cast<float>(v); };
  Keep(n++, tip.x - bound(space_.tip_min.x()));
  Keep(n++, bound(space_.tip_max.x()) - tip.x);
  Keep(n++, tip.y - bound(space_.tip_min.y()));
  Keep(n++, bound(space_.tip_max.y()) - tip.y);
  Keep(n++, tip.z - bound(space_.tip_min.z()));
  Keep(n++, bound(space_.tip_max.z()) - tip.z);

  Vec v{Lanes::Zero(), Lanes::Zero(), Lanes::Zero()};
  for (int i = 0; i < kNumJoints; ++i) {
    const Frame& f = frames[i + 1];
    const Vec& z = f.axis[2];
    const Vec d{tip.x - f.p.x, tip.y - f.p.y, tip.z - f.p.z};
    v.x += dq[i] * (z.y * d.z - z.z * d.y);
    v.y += dq[i] * (z.z * d.x - z.x * d.z);
    v.z += dq[i] * (z.x * d.y - z.y * d.x);
  }
  tip_speed_ = std::sqrt((v.x.square() + v.y.square() + v.z.square()).maxCoeff());
}

StopGuard::Clearance StopGuard::clearance() const noexcept {
  Clearance c{std::numeric_limits<float>::infinity(), std::numeric_limits<float>::infinity(),
              std::numeric_limits<float>::infinity()};
  for (int i = 0; i < kNumPairs; ++i) c.self = std::min(c.self, now_[i]);
  for (int i = kNumPairs; i < kNumPairs + kNumBodies; ++i) c.table = std::min(c.table, now_[i]);
  for (int i = kNumPairs + kNumBodies; i < kNumClearances; ++i) c.box = std::min(c.box, now_[i]);
  c.self += static_cast<float>(space_.self_margin);
  c.table += static_cast<float>(space_.table_margin);
  return c;
}

}  // namespace intabs
