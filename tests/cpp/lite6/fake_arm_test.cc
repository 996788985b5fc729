#include "intabs/lite6/fake_arm.h"

#include <catch2/catch.hpp>
#include <numbers>

namespace intabs::lite6 {
namespace {

const JointVector kHome = (JointVector() << 0, -.0164, .7773, 0, .7937, 0).finished();

struct Rig {
  FakeArm arm{kHome};
  Frame reply;

  // The reply's status.
  uint8_t Send(const Request& request) {
    Frame frame;
    EncodeRequest(request, 1, kHeartbeatProtocol, frame);
    FrameView view;
    size_t used = 0;
    REQUIRE(ParseFrame(frame.bytes.data(), static_cast<size_t>(frame.size), view, used) == Parsed::kFrame);
    arm.Handle(view, reply);
    return reply.bytes[kHeaderBytes];
  }
  uint8_t Payload(int i) const { return reply.bytes[static_cast<size_t>(kHeaderBytes + 1 + i)]; }
  int Error() {
    Send(Request::Bare(Register::kGetError));
    return Payload(0);
  }
  int State() {
    Send(Request::Bare(Register::kGetState));
    return Payload(0);
  }
  void Enable(VendorMode mode) {
    Send(Request::Bare(Register::kCleanError));
    CHECK((Send(Request::MotionEnable(true)) & kStatusInvalid) == 0);
    Send(Request::SetMode(mode));
    Send(Request::SetState(VendorState::kReady));
    CHECK(State() == 2);
  }
  void Tick(int n = 1) {
    for (int i = 0; i < n; ++i) arm.Tick();
  }
  // Joint 1 at `speed` [rad/s] for n ticks.
  void Swing(double speed, int n) {
    JointVector q = arm.q_ref();
    for (int i = 0; i < n && arm.Report(ReportKind::kNormal).error == 0; ++i) {
      q[0] += speed * .004;
      (void)Send(Request::ServoJ(q));
      Tick();
    }
  }
};

}  // namespace

TEST_CASE("Targets are taken when enabled, in servo mode and ready, and refused otherwise as the real arm does") {
  Rig rig;
  CHECK((rig.Send(Request::ServoJ(kHome)) & kStatusInvalid) != 0);  // mode 0
  rig.Enable(VendorMode::kServo);
  CHECK(rig.Send(Request::ServoJ(kHome)) == 0);
  rig.Send(Request::MotionEnable(false));
  rig.Tick();
  CHECK((rig.Send(Request::ServoJ(kHome)) & kStatusCannotMove) != 0);
  rig.Send(Request::MotionEnable(true));
  rig.Send(Request::SetMode(VendorMode::kServo));
  CHECK(rig.State() == 5);  // a change of mode wants a new SET_STATE
  CHECK((rig.Send(Request::ServoJ(kHome)) & kStatusCannotMove) != 0);
  rig.Send(Request::SetState(VendorState::kReady));
  CHECK(rig.Send(Request::ServoJ(kHome)) == 0);
  rig.Send(Request::SetState(VendorState::kStopped));
  CHECK((rig.Send(Request::ServoJ(kHome)) & kStatusCannotMove) != 0);
}

TEST_CASE("Targets too fast for a joint are C24, for the tool C60; just below is neither") {
  // Joint 1 moves the tip along a circle of .23 m: 500 mm/s is 2.1 rad/s.
  {
    Rig rig;
    rig.Enable(VendorMode::kServo);
    rig.Swing(2.5, 100);
    CHECK(rig.Error() == 0);
    rig.Swing(-2.8, 100);
    CHECK(rig.Error() == 60);
    CHECK((rig.Send(Request::ServoJ(kHome)) & kStatusError) != 0);
    CHECK(rig.State() == 4);
  }
  {
    Rig rig;
    rig.Enable(VendorMode::kServo);
    JointVector q = kHome;  // joint 6 does not move the tip
    for (int i = 0; i < 100; ++i) {
      q[5] += 3.1 * .004;
      rig.Send(Request::ServoJ(q));
      rig.Tick();
    }
    CHECK(rig.Error() == 0);
    q[5] += .2;
    rig.Send(Request::ServoJ(q));
    rig.Tick();
    CHECK(rig.Error() == 24);
  }
}

TEST_CASE("A target beyond a joint's limit is C23") {
  Rig rig;
  rig.Enable(VendorMode::kServo);
  JointVector q = kHome;
  q[1] = 151 * std::numbers::pi / 180;
  CHECK((rig.Send(Request::ServoJ(q)) & kStatusError) != 0);
  CHECK(rig.Error() == 23);
}

TEST_CASE("An error stops the arm within its brakes and lasts until it is cleared; the button lasts until it is released") {
  Rig rig;
  rig.Enable(VendorMode::kServo);
  rig.Swing(1, 50);
  rig.arm.RaiseError(31);
  double before = rig.arm.dq_ref()[0];
  CHECK(before > .9);
  for (int i = 0; i < 20; ++i) {
    rig.Tick();
    CHECK(before - rig.arm.dq_ref()[0] <= 20 * .004 + 1e-12);
    before = rig.arm.dq_ref()[0];
  }
  CHECK(rig.arm.dq_ref().isZero(0));
  rig.Enable(VendorMode::kServo);
  CHECK(rig.Error() == 0);
  rig.arm.SetEstopButton(true);
  rig.Send(Request::Bare(Register::kCleanError));
  CHECK(rig.Error() == 2);
  CHECK((rig.Send(Request::MotionEnable(true)) & kStatusInvalid) != 0);
  rig.arm.SetEstopButton(false);
  rig.Enable(VendorMode::kServo);
}

TEST_CASE("The gripper closes after it was open, not after it was stopped") {
  Rig rig;
  rig.Send(Request::SetToolOutput(0, false));
  rig.Send(Request::SetToolOutput(1, true));
  CHECK_FALSE(rig.arm.gripper_closed());
  rig.Send(Request::SetToolOutput(0, true));
  rig.Send(Request::SetToolOutput(1, false));
  rig.Send(Request::SetToolOutput(0, false));  // for a moment both are low
  rig.Tick(2);
  rig.Send(Request::SetToolOutput(1, true));
  CHECK(rig.arm.gripper_closed());
  rig.Send(Request::ReadTool(kToolOutputsRead));
  CHECK(rig.Payload(3) == 2);
  rig.Send(Request::SetToolOutput(1, false));
  rig.Tick(60);  // a stop
  rig.Send(Request::SetToolOutput(1, true));
  CHECK_FALSE(rig.arm.gripper_closed());
}

TEST_CASE("In manual mode a hand leads the arm; velocity mode moves for as long as it was told") {
  Rig rig;
  rig.Enable(VendorMode::kTeach);
  JointVector q = kHome;
  q[3] = .2;
  rig.arm.Guide(q);
  rig.Tick(200);
  CHECK(rig.arm.Report(ReportKind::kFull).q == q);
  rig.Enable(VendorMode::kJointVelocity);
  CHECK(rig.Send(Request::VelocityJ(JointVector::Unit(0) * .1, false, .2)) == 0);
  rig.Tick(100);
  CHECK(rig.arm.q_ref()[0] == Approx(.02));
  CHECK(rig.arm.dq_ref().isZero(0));
}

TEST_CASE("Moves in position mode are queued and done in turn") {
  Rig rig;
  rig.Enable(VendorMode::kPosition);
  JointVector a = kHome, b = kHome;
  a[0] = .1;
  b[0] = -.1;
  CHECK(rig.Send(Request::MoveJoint(a, 1, 10)) == 0);
  CHECK(rig.Send(Request::MoveJoint(b, 1, 10)) == 0);
  rig.Tick(25);
  CHECK(rig.arm.q_ref()[0] == Approx(.1));
  rig.Tick(60);
  CHECK(rig.arm.q_ref().isApprox(b, 1e-7));
}

TEST_CASE("An unknown register is refused with a warning") {
  Rig rig;
  CHECK((rig.Send(Request::Bare(static_cast<Register>(200))) & (kStatusInvalid | kStatusWarning)) ==
        (kStatusInvalid | kStatusWarning));
  rig.Send(Request::Bare(Register::kCleanWarning));
  CHECK((rig.Send(Request::Bare(Register::kGetState)) & kStatusWarning) == 0);
}

}  // namespace intabs::lite6
