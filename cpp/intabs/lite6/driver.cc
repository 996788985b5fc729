#include "intabs/lite6/driver.h"

#include <algorithm>

namespace intabs::lite6 {
namespace {

// The gripper has no feedback: its opening is estimated.
constexpr double kOpen = 0.0178;          // both fingers together [m]
constexpr double kGripperSpeed = 0.05;    // [m/s]
constexpr double kDt = kDriverPeriodUs * 1e-6;
// A target unanswered for so long: the arm does not hear us. A quarter more than the bridge makes good at once, so that
// what is made good at once is no fault.
constexpr int64_t kReplyAgeUs = Bridge::kGapUs * 5 / 4;

}  // namespace

Driver::Driver(const DriverOptions& options, Client::Log log, std::function<void()> on_client_thread)
    : mode_(options.client.mode),
      controller_(options.limits, options.model, options.safety),
      gripper_opening_(kOpen),
      client_(options.client, options.model, std::move(log), std::move(on_client_thread)) {}

void Driver::Offer(const ArmCommand& command) noexcept {
  const uint64_t written = written_.load(std::memory_order_relaxed);
  if (written - read_.load(std::memory_order_acquire) >= kQueue) {
    dropped_.fetch_add(1, std::memory_order_relaxed);
    return;
  }
  queue_[written % kQueue] = command;
  written_.store(written + 1, std::memory_order_release);
}

void Driver::Tick(int64_t now_us) noexcept {
  now_us_ = now_us;
  if (const ClientState* state = client_.Take()) state_ = *state;
  if (!born_) {
    if (state_.has_q) {
      controller_.Reset(state_.q, now_us);
      born_ = true;
    }
  }
  if (born_) {
    if (estop_.exchange(false, std::memory_order_acq_rel)) {
      controller_.Estop();
      pending_reset_ = 0;
    }
    FollowPhase();
    HandleReset();
    link_ok_ = LinkOk(now_us);
    controller_.SetLink(link_ok_);
    if (Teaches()) {
      GuideByHand(now_us);
    } else {
      HandleCommands(now_us);
    }
    for (const int64_t n = undecodable_.load(std::memory_order_relaxed); counted_undecodable_ < n;
         ++counted_undecodable_) {
      controller_.CountUndecodable();
    }
    controller_.Tick(now_us);
    const double wanted = (Teaches() ? guided_gripper_closed_ : controller_.gripper_closed()) ? 0 : kOpen;
    gripper_opening_ += std::clamp(wanted - gripper_opening_, -kGripperSpeed * kDt, kGripperSpeed * kDt);
    ++seq_;
  }
  Order();
}

// What the client met decides where the controller may be.
void Driver::FollowPhase() noexcept {
  switch (state_.phase) {
    case Phase::kDisconnected:
    case Phase::kConnected:
      if (was_ready_) controller_.Fail(Fault::kLink);
      break;
    case Phase::kPreparing:
      break;
    case Phase::kFault:
      if (state_.prepare == prepare_) {
        controller_.Fail(Fault::kVendor);
        pending_reset_ = 0;  // it was tried
      }
      break;
    case Phase::kStopped:
      if (controller_.state() != ArmState::kStopped && state_.prepare == prepare_) controller_.Fail(Fault::kVendor);
      break;
    case Phase::kReady:
      // Ready anew: the reference goes on from where the arm stands. Not before it has come to rest itself.
      if (state_.epoch != epoch_ && state_.epoch == prepare_ && controller_.Rebase(state_.q_ready)) {
        epoch_ = state_.epoch;
        was_ready_ = true;
        if (pending_reset_ != 0) controller_.ResetFault(pending_reset_);
        pending_reset_ = 0;
      }
      break;
  }
}

void Driver::HandleReset() noexcept {
  const int64_t session = reset_.exchange(0, std::memory_order_acq_rel);
  if (session <= 0) return;
  const ArmState state = controller_.state();
  if (state != ArmState::kFault && state != ArmState::kStopped) {
    controller_.ResetFault(session);
    return;
  }
  const bool alive = state_.phase == Phase::kReady && state_.epoch == epoch_ && epoch_ == prepare_;
  if (state == ArmState::kFault && alive) {
    controller_.ResetFault(session);
    return;
  }
  // The arm must be made ready first. One preparation at a time: its end looks at pending_reset_.
  pending_reset_ = session;
  if (state_.prepare == prepare_ && state_.phase != Phase::kPreparing) ++prepare_;
}

void Driver::HandleCommands(int64_t now_us) noexcept {
  const uint64_t written = written_.load(std::memory_order_acquire);
  uint64_t read = read_.load(std::memory_order_relaxed);
  for (; read < written; ++read) (void)controller_.Accept(queue_[read % kQueue], now_us);
  read_.store(read, std::memory_order_release);
  const ArmState state = controller_.state();
  gripper_valid_ |= state == ArmState::kTracking || state == ArmState::kAligning;
}

void Driver::GuideByHand(int64_t now_us) noexcept {
  // The reference is where the hand is. Braking from nothing takes no time, so at rest it always is.
  (void)controller_.Rebase(state_.q);
  const uint64_t written = written_.load(std::memory_order_acquire);
  uint64_t read = read_.load(std::memory_order_relaxed);
  for (; read < written; ++read) {
    const ArmCommand& c = queue_[read % kQueue];
    // Nobody can move an arm that is held by hand: a command is its gripper bit. Checked like any other.
    const Refusal refusal = controller_.Check(c, now_us);
    const bool old = c.session == guided_session_ && c.seq <= guided_seq_;
    if (refusal != Refusal::kAccepted || old) {
      controller_.Count(old ? Refusal::kOldSequence : refusal);
      continue;
    }
    guided_session_ = c.session;
    guided_seq_ = c.seq;
    guided_gripper_closed_ = c.gripper_closed;
    gripper_valid_ = true;
  }
  read_.store(read, std::memory_order_release);
  if (toggle_gripper_.exchange(false, std::memory_order_acq_rel)) {
    guided_gripper_closed_ = !guided_gripper_closed_;
    gripper_valid_ = true;
  }
}

bool Driver::LinkOk(int64_t now_us) const noexcept {
  if (state_.phase != Phase::kReady || state_.epoch != epoch_ || state_.slow) return false;
  if (mode_ == VendorMode::kServo && now_us - state_.reply_us > kReplyAgeUs) return false;
  return state_.report_us != 0 && now_us - state_.report_us <= state_.report_age_limit_us;
}

void Driver::Order() noexcept {
  ClientOrder order;
  order.q = controller_.q_ref();
  order.epoch = epoch_;
  order.prepare = prepare_;
  order.stop = controller_.state() == ArmState::kStopped && pending_reset_ == 0 && controller_.dq_ref().isZero(0);
  order.gripper_valid = gripper_valid_ && controller_.state() != ArmState::kStopped &&
                        controller_.state() != ArmState::kFault;
  order.gripper_closed = Teaches() ? guided_gripper_closed_ : controller_.gripper_closed();
  client_.Send(order);
}

void Driver::FillStatus(ArmStatus& s) const noexcept {
  s.utime = now_us_;
  s.seq = seq_;
  s.q = state_.q;
  s.dq = state_.dq;
  s.tau = state_.tau;
  controller_.FillStatus(s);
  if (Teaches()) {
    s.gripper_closed = guided_gripper_closed_;
    s.session = guided_session_;
    s.last_command_seq = guided_seq_;
  }
  s.gripper_opening = gripper_opening_;
  s.vendor_error = state_.vendor_error;
}

void Driver::FillRecord(TickRecord& r) const noexcept {
  controller_.FillRecord(r);
  r.utime = now_us_;
  for (int i = 0; i < kNumJoints; ++i) {
    r.q[i] = state_.q[i];
    r.dq[i] = state_.dq[i];
  }
  r.measured_utime = state_.report_us;
  r.vendor_error = state_.vendor_error;
}

}  // namespace intabs::lite6
