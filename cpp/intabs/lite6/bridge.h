// From the command filter's reference to what is sent. Pure, fixed memory, real-time safe.
//
// As long as every target arrives, what is sent is the reference. After a gap (late replies, a busy host) the arm stands
// at the last target it heard while the reference went on; the controller would follow a jump like a step, at 180 degrees/s.
#pragma once

#include "intabs/control/arm_controller.h"
#include "intabs/core/types.h"

namespace intabs::lite6 {

class Bridge {
 public:
  // A gap longer than this [us] is made good slowly, while the reference is held; a shorter one at once, within
  // the limits.
  static constexpr int64_t kGapUs = 20000;
  static constexpr double kSpeed = 3.0, kTipSpeed = 0.58;         // [rad/s], [m/s]; the guards are at 3.14 and .6
  static constexpr double kSlowSpeed = 0.2, kSlowTipSpeed = 0.05;

  explicit Bridge(const ArmModel& model) noexcept : model_(model) {}

  // The arm stands here.
  void Reset(const JointVector& q, int64_t now_us) noexcept {
    sent_ = q;
    sent_us_ = now_us;
    slow_ = false;
  }

  // The next target to send [rad], one driver period after the last one.
  const JointVector& Step(const JointVector& q_ref, int64_t now_us) noexcept {
    const JointVector way = q_ref - sent_;
    const double longest = way.cwiseAbs().maxCoeff();
    if (now_us - sent_us_ > kGapUs && longest > 1e-3) slow_ = true;
    constexpr double kDt = kDriverPeriodUs * 1e-6;
    const double most = kDt * (slow_ ? kSlowSpeed : kSpeed), tip_most = kDt * (slow_ ? kSlowTipSpeed : kTipSpeed);
    double part = longest > most ? most / longest : 1;
    const double tip_way = (model_.Tip(sent_ + part * way).p - model_.Tip(sent_).p).norm();
    if (tip_way > tip_most) part *= tip_most / tip_way;
    if (part < 1) {
      sent_ += part * way;
    } else {
      sent_ = q_ref;
      slow_ = false;
    }
    sent_us_ = now_us;
    return sent_;
  }

  const JointVector& sent() const noexcept { return sent_; }
  // Making good a gap: the reference must wait.
  bool slow() const noexcept { return slow_; }

 private:
  const ArmModel model_;
  JointVector sent_ = JointVector::Zero();
  int64_t sent_us_ = 0;
  bool slow_ = false;
};

}  // namespace intabs::lite6
