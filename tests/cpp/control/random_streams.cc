#include "random_streams.h"

#include <limits>
#include <random>
#include <sstream>

#include "intabs/control/arm_controller.h"
#include "reference_shape.h"

namespace intabs {
namespace {

constexpr double kDt = 0.004;
constexpr double kRounding = 1e-9;

class Stream {
 public:
  explicit Stream(uint64_t number)
      : random_(number * 0x9e3779b97f4a7c15u + 1), controller_(limits_, model_, Safety()) {}

  std::string Run(StreamFigures& f) {
    start_ = ClearPose();
    controller_.Reset(start_, now_us_);
    base_ = x_ = start_;
    tip_ = Measure(model_, x_).tip;
    const int ticks = static_cast<int>(60 * std::pow(10, 1.2 * U() * U() * U()));  // 60 .. 950, mostly short
    kind_ = random_() % 8;
    for (int tick = 0; tick < ticks; ++tick) {
      if (U() < 0.01) kind_ = random_() % 8;
      Feed(tick);
      if (std::string fault = Tick(f); !fault.empty()) {
        std::ostringstream text;
        text.precision(17);
        text << fault << " at tick " << tick << "; state " << static_cast<int>(controller_.state()) << "; q "
             << controller_.q_ref().transpose() << "; dq " << controller_.dq_ref().transpose() << "; ddq "
             << controller_.ddq_ref().transpose() << "; last target " << sent_.q_target.transpose()
             << "; dq_max " << sent_.dq_max.transpose() << "; started at " << start_.transpose();
        return text.str();
      }
    }
    ++f.streams;
    f.ticks += ticks;
    return "";
  }

 private:
  double U() { return static_cast<double>(random_() >> 11) * 0x1p-53; }
  ArmSafety Safety() {
    ArmSafety s;
    if (U() < 0.7) s.align_within = 100;  // most streams jump at once
    return s;
  }
  JointVector RandomPose() {
    return JointVector::NullaryExpr(
        [&](Eigen::Index i) { return limits_.q_min[i] + U() * (limits_.q_max[i] - limits_.q_min[i]); });
  }
  JointVector ClearPose() {
    while (true) {
      const JointVector q = RandomPose();
      const ReferenceClearance c = Measure(model_, q);
      if (c.self > 0.0101 && c.table > 0.0021 && BoxClearance(c.tip) > 1e-4) return q;
    }
  }
  double BoxClearance(const Eigen::Vector3d& tip) const {
    return std::min((tip - limits_.space.tip_min).minCoeff(), (limits_.space.tip_max - tip).minCoeff());
  }

  void Feed(int tick) {
    constexpr double kNan = std::numeric_limits<double>::quiet_NaN(),
                     kInf = std::numeric_limits<double>::infinity();
    // How often, by kind of stream: every tick, 25 Hz, 25 Hz with jitter, now and then.
    const bool due = kind_ == 0   ? true
                     : kind_ <= 3 ? tick % 10 == 0
                     : kind_ <= 5 ? tick >= next_due_
                                  : U() < 0.05;
    if (due) {
      next_due_ = tick + 6 + static_cast<int>(random_() % 9);
      ArmCommand c;
      c.session = U() < 0.98 ? 5 : 6;
      c.seq = ++seq_;
      c.mode = ArmMode::kServo;
      switch (kind_ == 6 && U() < 0.5 ? 0 : random_() % 16) {
        case 0:
          base_ = RandomPose();
          slope_.setZero();
          break;
        case 1:
          base_ = JointVector::NullaryExpr(
              [&](Eigen::Index i) { return U() < 0.5 ? limits_.q_min[i] : limits_.q_max[i]; });
          break;
        case 2:
          slope_ = JointVector::NullaryExpr([&](Eigen::Index) { return 0.2 * (U() - 0.5); });
          break;
        case 3:
          slope_.setZero();
          base_ = x_;
          break;
        case 4:  // a step of one joint
          base_[random_() % 6] += 2 * (U() - 0.5);
          break;
        default:
          base_ += slope_ + 0.002 * JointVector::NullaryExpr([&](Eigen::Index) { return U() - 0.5; });
      }
      if (kind_ != 7)
        base_ = base_.cwiseMax(limits_.q_min).cwiseMin(limits_.q_max);  // kind 7 leaves the limits
      c.q_target = base_;
      if (U() < 0.2)
        c.dq_max = JointVector::NullaryExpr([&](Eigen::Index) { return 3 * std::pow(U(), 4) + 1e-9; });
      c.lifetime_us = U() < 0.8 ? 200000 : static_cast<int64_t>(100000 * U());
      switch (random_() % 40) {
        case 0:
          c.q_target[random_() % 6] = kNan;
          break;
        case 1:
          c.q_target[random_() % 6] = U() < 0.5 ? kInf : -kInf;
          break;
        case 2:
          c.dq_max[random_() % 6] = U() < 0.5 ? kInf : kNan;
          break;
        case 3:
          c.seq = seq_ - static_cast<int64_t>(random_() % 5);
          break;  // again, or out of order
        case 4:
          c.mode = static_cast<ArmMode>(random_() % 3);
          break;
        case 5:
          c.q_target *= 1e300;
          break;
        case 6:
          c.lifetime_us = static_cast<int64_t>(random_());
          break;
        default:
          break;
      }
      sent_ = c;
      (void)controller_.Accept(c, now_us_);
      if (U() < 0.02) (void)controller_.Accept(c, now_us_);
    }
    if (U() < 0.002) controller_.Estop();
    if (U() < 0.001) controller_.Fail(Fault::kVendor);
    if (U() < 0.02) controller_.ResetFault(5);
    if (U() < 0.003) controller_.SetLink(U() < 0.3);
    if (U() < 0.02) controller_.SetLink(true);
    if (U() < 0.002) now_us_ += static_cast<int64_t>(3e6 * U());  // the clock jumps
  }

  std::string Tick(StreamFigures& f) {
    now_us_ += 4000;
    controller_.Tick(now_us_);
    const JointVector &x = controller_.q_ref(), &v = controller_.dq_ref(), &a = controller_.ddq_ref();
    if (!x.allFinite() || !v.allFinite() || !a.allFinite()) return "not finite";
    const bool declared = controller_.filter().halted();
    f.halts += declared && !was_declared_;
    was_declared_ = declared;
    f.blocked_ticks += controller_.filter().blocked();

    const auto most = [](const JointVector& u) { return u.cwiseAbs().maxCoeff(); };
    const double position = std::max((x - limits_.q_max).maxCoeff(), (limits_.q_min - x).maxCoeff());
    const double speed = std::max(most(v), most((x - x_) / kDt));
    const double acceleration = std::max(most(a), most((v - v_) / kDt));
    const double jerk = declared ? 0 : most((a - a_) / kDt);
    const ReferenceClearance c = Measure(model_, x);
    const double tcp = (c.tip - tip_).norm() / kDt;
    const double box = BoxClearance(c.tip);
    f.max_position = std::max(f.max_position, position);
    f.max_speed = std::max(f.max_speed, speed);
    f.max_acceleration = std::max(f.max_acceleration, acceleration);
    f.max_jerk = std::max(f.max_jerk, jerk);
    f.max_tcp = std::max(f.max_tcp, tcp);
    f.min_self = std::min(f.min_self, c.self);
    f.min_table = std::min(f.min_table, c.table);
    f.min_box = std::min(f.min_box, box);
    x_ = x;
    v_ = v;
    a_ = a;
    tip_ = c.tip;
    if (position > kRounding) return "position " + std::to_string(position) + " beyond a limit";
    if (speed > 2.14 + kRounding) return "speed " + std::to_string(speed);
    if (acceleration > 20 + kRounding) return "acceleration " + std::to_string(acceleration);
    if (jerk > 500 + 500 * kRounding) return "jerk " + std::to_string(jerk);
    if (tcp > 0.6) return "tip speed " + std::to_string(tcp);
    if (c.self < 0) return "capsules " + std::to_string(c.self) + " apart";
    if (c.table < 0) return "table " + std::to_string(c.table) + " below";
    if (box < -1e-3) return "tip " + std::to_string(-box) + " outside its box";
    return "";
  }

  const ArmLimits limits_;
  const ArmModel model_ = ArmModel::Lite6();
  std::mt19937_64 random_;
  ArmController controller_;
  int64_t now_us_ = 1000000, seq_ = 0;
  int next_due_ = 0;
  uint64_t kind_ = 0;
  JointVector start_, base_, slope_ = JointVector::Zero();
  ArmCommand sent_;
  JointVector x_, v_ = JointVector::Zero(), a_ = JointVector::Zero();
  Eigen::Vector3d tip_;
  bool was_declared_ = false;
};

}  // namespace

std::string RunStream(uint64_t number, StreamFigures& figures) { return Stream(number).Run(figures); }

}  // namespace intabs
