#include "intabs/control/arm_controller.h"

#include <algorithm>
#include <catch2/catch.hpp>
#include <cstring>
#include <limits>
#include <random>

#include "common/alloc_hook.h"

namespace intabs {
namespace {

// An arm on a clock of its own, with the pose it starts in.
class Rig {
 public:
  // Targets are followed at once, however far they are, but where a test is about that.
  explicit Rig(const ArmSafety& safety = {.align_within = 100})
      : controller(ArmLimits{}, ArmModel::Lite6(), safety) {
    home << 0.1, 0.2, 1.0, 0, 0.8, 0;
    controller.Reset(home, now);
  }
  void Tick(int n = 1) {
    for (int i = 0; i < n; ++i) {
      now += kDriverPeriodUs;
      controller.Tick(now);
    }
  }
  void Seconds(double s) { Tick(static_cast<int>(s * 250 + 0.5)); }
  Refusal Send(const ArmCommand& c) { return controller.Accept(c, now); }
  // A command that asks for joint 1 to turn to `q1`.
  ArmCommand Command(int64_t session, int64_t seq, double q1 = 1.0) const {
    ArmCommand c;
    c.session = session;
    c.seq = seq;
    c.mode = ArmMode::kServo;
    c.q_target = home;
    c.q_target[0] = q1;
    return c;
  }
  ArmCommand Hold(int64_t session, int64_t seq) const {
    ArmCommand c = Command(session, seq);
    c.mode = ArmMode::kHold;
    return c;
  }
  ArmStatus Status() const {
    ArmStatus s;
    controller.FillStatus(s);
    return s;
  }
  int Refused(Refusal r) const { return Status().refused[static_cast<int>(r)]; }
  bool Moves() const { return !controller.dq_ref().isZero(0); }

  int64_t now = 1000000;
  ArmController controller;
  JointVector home;
};

constexpr int64_t kA = 0x1234567890abcdef, kB = 77;

}  // namespace

TEST_CASE("Before the first command the arm holds the pose it was found in") {
  Rig rig;
  rig.Seconds(10);
  CHECK(rig.controller.q_ref() == rig.home);
  CHECK_FALSE(rig.Moves());
  CHECK(rig.Status().state == ArmState::kIdle);
  CHECK(rig.Status().session == 0);
  CHECK(rig.Status().fault == Fault::kNone);
}

TEST_CASE("A session is adopted in idle, and its commands are followed") {
  Rig rig;
  CHECK(rig.Send(rig.Command(kA, 5)) == Refusal::kAccepted);
  rig.Tick(10);
  CHECK(rig.Moves());
  const ArmStatus s = rig.Status();
  CHECK(s.session == kA);
  CHECK(s.state == ArmState::kTracking);
  CHECK(s.mode == ArmMode::kServo);
  CHECK(s.last_command_seq == 5);
  CHECK(s.q_commanded == rig.controller.q_ref());
}

TEST_CASE("The gripper does what the last command of the session says") {
  Rig rig;
  ArmCommand c = rig.Command(kA, 1);
  c.gripper_closed = true;
  REQUIRE(rig.Send(c) == Refusal::kAccepted);
  CHECK(rig.controller.gripper_closed());
  REQUIRE(rig.Send(rig.Hold(kA, 2)) == Refusal::kAccepted);  // says open, but holding drops nothing
  CHECK(rig.controller.gripper_closed());
  REQUIRE(rig.Send(rig.Command(kA, 3)) == Refusal::kAccepted);
  CHECK_FALSE(rig.controller.gripper_closed());
}

TEST_CASE("A stale command makes the arm slow down, hold, then fault") {
  Rig rig;
  REQUIRE(rig.Send(rig.Command(kA, 1, 3.0)) == Refusal::kAccepted);
  rig.Seconds(0.2);  // its lifetime, to the microsecond
  CHECK(rig.Status().state == ArmState::kTracking);
  CHECK(rig.Moves());
  rig.Tick();
  CHECK(rig.Status().state == ArmState::kSlowing);
  CHECK(rig.Status().mode == ArmMode::kHold);
  const double a = rig.controller.ddq_ref()[0];
  rig.Tick();
  CHECK(rig.controller.ddq_ref()[0] == Approx(a - 500 * 0.004));  // as hard as the jerk limit lets it
  rig.Seconds(0.3);
  CHECK(rig.Status().state == ArmState::kHolding);
  CHECK_FALSE(rig.Moves());
  CHECK(rig.Status().fault == Fault::kNone);
  const JointVector held = rig.controller.q_ref();
  CHECK(held[0] < 3.0);
  rig.Seconds(2);
  CHECK(rig.Status().state == ArmState::kFault);
  CHECK(rig.Status().fault == Fault::kStaleCommand);
  CHECK(rig.Status().session == kA);
  CHECK(rig.controller.q_ref() == held);
}

TEST_CASE("Out of slowing and holding the session goes on without a RESET") {
  Rig rig;
  REQUIRE(rig.Send(rig.Command(kA, 1, 3.0)) == Refusal::kAccepted);
  rig.Seconds(0.22);
  REQUIRE(rig.Status().state == ArmState::kSlowing);
  CHECK(rig.Send(rig.Command(kA, 2, 3.0)) == Refusal::kAccepted);
  CHECK(rig.Status().state == ArmState::kTracking);
  rig.Seconds(1.5);
  REQUIRE(rig.Status().state == ArmState::kHolding);
  CHECK(rig.Send(rig.Command(kA, 3, 3.0)) == Refusal::kAccepted);
  rig.Tick();
  CHECK(rig.Moves());
}

TEST_CASE("A hold command slows down and holds, and never becomes a fault") {
  Rig rig;
  REQUIRE(rig.Send(rig.Command(kA, 1, 3.0)) == Refusal::kAccepted);
  rig.Seconds(0.1);
  REQUIRE(rig.Send(rig.Hold(kA, 2)) == Refusal::kAccepted);
  rig.Tick();
  CHECK(rig.Status().state == ArmState::kSlowing);
  rig.Seconds(0.2);
  CHECK(rig.Status().state == ArmState::kHolding);
  rig.Seconds(10);
  CHECK(rig.Status().state == ArmState::kHolding);
  CHECK(rig.Status().fault == Fault::kNone);
}

TEST_CASE("A hold command after a gap ends the way to a fault") {
  Rig rig;
  REQUIRE(rig.Send(rig.Command(kA, 1, 3.0)) == Refusal::kAccepted);
  rig.Seconds(1.5);
  REQUIRE(rig.Status().state == ArmState::kHolding);
  REQUIRE(rig.Send(rig.Hold(kA, 2)) == Refusal::kAccepted);
  rig.Seconds(5);
  CHECK(rig.Status().state == ArmState::kHolding);
}

TEST_CASE(
    "While a session is in command, another one is refused: tracking, slowing, and holding with a valid "
    "command") {
  Rig rig;
  REQUIRE(rig.Send(rig.Command(kA, 1, 3.0)) == Refusal::kAccepted);
  rig.Tick(5);
  CHECK(rig.Send(rig.Command(kB, 1)) == Refusal::kForeignSession);
  CHECK(rig.Status().session == kA);
  rig.Seconds(0.19);
  REQUIRE(rig.Status().state == ArmState::kSlowing);
  CHECK(rig.Send(rig.Command(kB, 2)) == Refusal::kForeignSession);
  REQUIRE(rig.Send(rig.Hold(kA, 2)) == Refusal::kAccepted);
  rig.Seconds(0.19);
  REQUIRE(rig.Status().state == ArmState::kHolding);
  CHECK(rig.controller.Busy(rig.now));
  CHECK(rig.Send(rig.Command(kB, 3)) == Refusal::kForeignSession);
  rig.Seconds(0.02);  // now the hold command has run out
  CHECK_FALSE(rig.controller.Busy(rig.now));
  CHECK(rig.Send(rig.Command(kB, 4)) == Refusal::kAccepted);
  CHECK(rig.Status().session == kB);
  CHECK(rig.Refused(Refusal::kForeignSession) == 3);
}

TEST_CASE("A new session takes over from one that died, once the arm holds") {
  Rig rig;
  REQUIRE(rig.Send(rig.Command(kA, 100, 3.0)) == Refusal::kAccepted);
  rig.Seconds(1);
  REQUIRE(rig.Status().state == ArmState::kHolding);
  CHECK(rig.Send(rig.Command(kB, 1)) == Refusal::kAccepted);  // its own count of seq
  rig.Tick(5);
  CHECK(rig.Moves());
  CHECK(rig.Send(rig.Command(kA, 101)) == Refusal::kForeignSession);
}

TEST_CASE("In a fault no command is taken, only a RESET that names the next session leads out") {
  Rig rig;
  REQUIRE(rig.Send(rig.Command(kA, 1, 3.0)) == Refusal::kAccepted);
  rig.Seconds(3);
  REQUIRE(rig.Status().state == ArmState::kFault);
  CHECK(rig.Send(rig.Command(kA, 2)) == Refusal::kForeignSession);
  CHECK(rig.Send(rig.Command(kB, 1)) == Refusal::kForeignSession);
  rig.controller.ResetFault(0);  // names nobody
  CHECK(rig.Status().state == ArmState::kFault);
  rig.controller.ResetFault(kB);
  CHECK(rig.Status().state == ArmState::kHolding);
  CHECK(rig.Status().fault == Fault::kNone);
  CHECK(rig.Status().session == kB);
  CHECK(rig.Send(rig.Command(kA, 3)) == Refusal::kForeignSession);  // still streaming, but not named
  rig.Seconds(5);
  CHECK(rig.Status().state == ArmState::kHolding);
  CHECK(rig.Send(rig.Command(kB, 1)) == Refusal::kAccepted);
  rig.Tick(5);
  CHECK(rig.Moves());
}

TEST_CASE("After a RESET for a session that never came, another RESET may name another one") {
  Rig rig;
  rig.controller.Estop();
  rig.controller.ResetFault(kA);
  CHECK(rig.Send(rig.Command(kB, 1)) == Refusal::kForeignSession);
  rig.controller.ResetFault(kB);
  CHECK(rig.Send(rig.Command(kB, 1)) == Refusal::kAccepted);
  rig.controller.ResetFault(kA);  // too late: a session runs
  rig.Tick();
  CHECK(rig.Status().session == kB);
  CHECK(rig.Status().state == ArmState::kTracking);
}

TEST_CASE("A RESET does not bring old commands of the same session back") {
  Rig rig;
  REQUIRE(rig.Send(rig.Command(kA, 7, 3.0)) == Refusal::kAccepted);
  rig.Seconds(3);
  rig.controller.ResetFault(kA);
  CHECK(rig.Send(rig.Command(kA, 7)) == Refusal::kOldSequence);
  CHECK(rig.Send(rig.Command(kA, 8)) == Refusal::kAccepted);
}

TEST_CASE("ESTOP brakes within the limits and stays until a RESET") {
  Rig rig;
  REQUIRE(rig.Send(rig.Command(kA, 1, 3.0)) == Refusal::kAccepted);
  rig.Seconds(0.15);
  const double speed = rig.controller.dq_ref()[0];
  REQUIRE(speed > 0.5);
  rig.controller.Estop();
  CHECK(rig.Status().state == ArmState::kStopped);
  CHECK(rig.Status().fault == Fault::kEstop);
  rig.Tick();
  CHECK(rig.controller.dq_ref()[0] == Approx(speed - 20 * 0.004));
  CHECK(rig.Send(rig.Command(kA, 2)) == Refusal::kForeignSession);
  SECTION("and holds") {
    rig.Seconds(5);
    CHECK_FALSE(rig.Moves());
    CHECK(rig.Status().state == ArmState::kStopped);
    CHECK(rig.Status().fault == Fault::kEstop);
    rig.controller.ResetFault(kA);
    CHECK(rig.Status().state == ArmState::kHolding);
    rig.Tick(10);
    CHECK_FALSE(rig.Moves());  // what was commanded before is forgotten
  }
  SECTION("a RESET while it still moves lets it come to rest first") {
    rig.controller.ResetFault(kA);
    CHECK(rig.Status().state == ArmState::kSlowing);
    rig.Seconds(0.3);
    CHECK(rig.Status().state == ArmState::kHolding);
    CHECK_FALSE(rig.controller.Busy(rig.now));
    rig.Seconds(5);
    CHECK(rig.Status().state == ArmState::kHolding);
  }
}

TEST_CASE("After an ESTOP nothing of the command before it counts") {
  Rig rig;
  REQUIRE(rig.Send(rig.Command(kA, 1, 0.11)) == Refusal::kAccepted);
  SECTION("that was still valid") {
    rig.Tick(10);
    rig.controller.Estop();
    rig.controller.ResetFault(kA);
    rig.Tick(30);
    REQUIRE(rig.Status().state == ArmState::kHolding);
    CHECK_FALSE(rig.controller.Busy(rig.now));
  }
  SECTION("that had gone stale") {
    rig.Seconds(1.5);
    rig.controller.Estop();
    rig.controller.ResetFault(kA);
    rig.Seconds(5);
    CHECK(rig.Status().state == ArmState::kHolding);
  }
}

TEST_CASE("Bad commands are refused by kind, counted, and move nothing") {
  const double nan = std::numeric_limits<double>::quiet_NaN(), inf = std::numeric_limits<double>::infinity();
  struct Bad {
    const char* what;
    Refusal refusal;
    void (*spoil)(ArmCommand&, double, double);
  };
  const Bad kinds[] = {
      {"session 0", Refusal::kForeignSession, [](ArmCommand& c, double, double) { c.session = 0; }},
      {"session < 0", Refusal::kForeignSession, [](ArmCommand& c, double, double) { c.session = -5; }},
      {"unknown mode", Refusal::kUnknownMode, [](ArmCommand& c, double, double) { c.mode = ArmMode{9}; }},
      {"NaN", Refusal::kNotFinite, [](ArmCommand& c, double n, double) { c.q_target[3] = n; }},
      {"infinity", Refusal::kNotFinite, [](ArmCommand& c, double, double i) { c.q_target[0] = -i; }},
      {"NaN speed", Refusal::kNotFinite, [](ArmCommand& c, double n, double) { c.dq_max[5] = n; }},
      {"beyond a joint limit", Refusal::kOutOfRange,
       [](ArmCommand& c, double, double) { c.q_target[2] = -0.07; }},
      {"speed 0", Refusal::kOutOfRange, [](ArmCommand& c, double, double) { c.dq_max[2] = 0; }},
      {"lifetime 0", Refusal::kOutOfRange, [](ArmCommand& c, double, double) { c.lifetime_us = 0; }},
      {"endless lifetime", Refusal::kOutOfRange,
       [](ArmCommand& c, double, double) { c.lifetime_us = INT64_MAX; }},
      {"repeated", Refusal::kOldSequence, [](ArmCommand& c, double, double) { c.seq = 10; }},
      {"reordered", Refusal::kOldSequence, [](ArmCommand& c, double, double) { c.seq = 9; }},
  };
  for (const Bad& bad : kinds) {
    INFO(bad.what);
    Rig rig, twin;
    for (Rig* r : {&rig, &twin}) {
      REQUIRE(r->Send(r->Command(kA, 10, 0.15)) == Refusal::kAccepted);
      r->Tick(3);
    }
    ArmCommand c = rig.Command(kA, 11, -1.0);
    c.gripper_closed = true;
    bad.spoil(c, nan, inf);
    CHECK(rig.Send(c) == bad.refusal);
    CHECK(rig.Refused(bad.refusal) == 1);
    // From here on everything is as if it had never come.
    for (int i = 0; i < 200; ++i) {
      rig.Tick();
      twin.Tick();
      REQUIRE(rig.controller.q_ref() == twin.controller.q_ref());
      REQUIRE(rig.Status().state == twin.Status().state);
    }
    CHECK_FALSE(rig.controller.gripper_closed());
    if (bad.refusal != Refusal::kOldSequence) {
      Rig idle;
      CHECK(idle.Send(c) == bad.refusal);
      CHECK(idle.Status().session == 0);  // nor is its session adopted
    }
  }
  Rig rig;
  rig.controller.CountUndecodable();
  CHECK(rig.Status().refused[0] == 1);
}

TEST_CASE("A first target far away is approached slowly, then followed") {
  Rig rig{ArmSafety{}};
  REQUIRE(rig.Send(rig.Command(kA, 1, 1.0)) == Refusal::kAccepted);
  CHECK(rig.Status().state == ArmState::kAligning);
  CHECK(rig.controller.Busy(rig.now));
  CHECK(rig.Send(rig.Command(kB, 1, 1.0)) == Refusal::kForeignSession);
  int64_t seq = 1;
  for (int i = 0; i < 1000 && rig.Status().state == ArmState::kAligning; ++i) {
    if (i % 10 == 0) REQUIRE(rig.Send(rig.Command(kA, ++seq, 1.0)) == Refusal::kAccepted);
    rig.Tick();
    if (rig.Status().state == ArmState::kAligning) CHECK(std::abs(rig.controller.dq_ref()[0]) <= 0.35 + 1e-9);
  }
  CHECK(rig.Status().state == ArmState::kTracking);
  CHECK(rig.controller.q_ref()[0] == Approx(0.9).margin(0.005));
  // From now on it may jump: the filter alone decides how fast.
  REQUIRE(rig.Send(rig.Command(kA, ++seq, -1.0)) == Refusal::kAccepted);
  rig.Seconds(0.15);
  CHECK(rig.Status().state == ArmState::kTracking);
  CHECK(rig.controller.dq_ref()[0] < -0.5);
  SECTION("a stale command while it aligns slows down and holds as well") {
    Rig other{ArmSafety{}};
    REQUIRE(other.Send(other.Command(kA, 1, 1.0)) == Refusal::kAccepted);
    other.Seconds(0.204);
    CHECK(other.Status().state == ArmState::kSlowing);
    other.Seconds(0.2);
    CHECK(other.Status().state == ArmState::kHolding);
  }
  SECTION("after a hold far away it aligns again") {
    rig.Seconds(1.5);
    REQUIRE(rig.Status().state == ArmState::kHolding);
    REQUIRE(rig.Send(rig.Command(kA, ++seq, 1.5)) == Refusal::kAccepted);
    CHECK(rig.Status().state == ArmState::kAligning);
  }
}

TEST_CASE("Without a link the arm slows down and holds, commands move nothing, and after 2 s it is a fault") {
  Rig rig;
  int64_t seq = 0;
  const auto seconds = [&](double s) {  // with commands
    for (int i = 0; i < s * 250; ++i) {
      if (i % 10 == 0) (void)rig.Send(rig.Command(kA, ++seq, 3.0));
      rig.Tick();
    }
  };
  seconds(0.2);
  REQUIRE(rig.Moves());
  rig.controller.SetLink(false);
  rig.Tick();
  CHECK(rig.Status().state == ArmState::kSlowing);
  seconds(0.4);
  CHECK(rig.Status().state == ArmState::kHolding);
  CHECK_FALSE(rig.Moves());
  SECTION("when it comes back in time the session goes on") {
    seconds(1);
    CHECK_FALSE(rig.Moves());
    rig.controller.SetLink(true);
    seconds(0.1);
    CHECK(rig.Status().state == ArmState::kTracking);
    CHECK(rig.Moves());
    CHECK(rig.Status().fault == Fault::kNone);
  }
  SECTION("when it does not, only a RESET leads out") {
    seconds(2);
    CHECK(rig.Status().state == ArmState::kFault);
    CHECK(rig.Status().fault == Fault::kStaleStatus);
    rig.controller.SetLink(true);
    seconds(0.1);
    CHECK(rig.Status().state == ArmState::kFault);
    rig.controller.ResetFault(kA);
    seconds(0.1);
    CHECK(rig.Status().state == ArmState::kTracking);
  }
  SECTION("a link that is gone again right after a RESET is a fault again, after 2 s anew") {
    seconds(2);
    rig.controller.ResetFault(kA);
    seconds(1);
    CHECK(rig.Status().state == ArmState::kHolding);
    seconds(1.5);
    CHECK(rig.Status().state == ArmState::kFault);
  }
}

TEST_CASE(
    "A vendor error or a lost connection brakes at once and stays until a RESET; the first one is kept") {
  for (const Fault fault : {Fault::kVendor, Fault::kLink}) {
    Rig rig;
    REQUIRE(rig.Send(rig.Command(kA, 1, 3.0)) == Refusal::kAccepted);
    rig.Seconds(0.15);
    const double speed = rig.controller.dq_ref()[0];
    REQUIRE(speed > 0.5);
    rig.controller.Fail(fault);
    CHECK(rig.Status().state == ArmState::kFault);
    rig.Tick();
    CHECK(rig.controller.dq_ref()[0] == Approx(speed - 20 * 0.004));
    rig.controller.Fail(Fault::kOverrun);
    CHECK(rig.Status().fault == fault);
    CHECK(rig.Send(rig.Command(kA, 2)) == Refusal::kForeignSession);
    rig.Seconds(1);
    CHECK_FALSE(rig.Moves());
    rig.controller.Estop();  // outranks it
    CHECK(rig.Status().state == ArmState::kStopped);
    rig.controller.Fail(fault);
    CHECK(rig.Status().fault == Fault::kEstop);
    rig.controller.ResetFault(kA);
    CHECK(rig.Send(rig.Command(kA, 2)) == Refusal::kAccepted);
  }
}

TEST_CASE("A loop that stood still in motion is a fault, and the reference stands still with the arm") {
  Rig rig{{.align_within = 100, .stall_us = 40000}};
  REQUIRE(rig.Send(rig.Command(kA, 1, 3.0)) == Refusal::kAccepted);
  rig.Seconds(0.1);
  rig.now += 30000;  // late, but not too late
  rig.Tick();
  CHECK(rig.Status().state == ArmState::kTracking);
  const JointVector q = rig.controller.q_ref();
  rig.now += 60000;
  rig.Tick();
  CHECK(rig.Status().state == ArmState::kFault);
  CHECK(rig.Status().fault == Fault::kOverrun);
  CHECK(rig.controller.q_ref() == q);
  CHECK_FALSE(rig.Moves());
  rig.controller.ResetFault(kA);
  REQUIRE(rig.Send(rig.Command(kA, 2, 3.0)) == Refusal::kAccepted);
  rig.Tick();
  CHECK(rig.Status().state == ArmState::kTracking);
  SECTION("at rest it is none") {
    rig.Seconds(1);
    rig.now += 500000;
    rig.Tick();
    CHECK(rig.Status().fault == Fault::kNone);
  }
}

TEST_CASE("The reference starts anew from a measured pose, at rest and only then") {
  Rig rig;
  JointVector measured = rig.home;
  measured[1] += 0.05;
  CHECK(rig.controller.Rebase(measured));
  CHECK(rig.controller.q_ref() == measured);
  CHECK(rig.Status().state == ArmState::kIdle);
  REQUIRE(rig.Send(rig.Command(kA, 1, 3.0)) == Refusal::kAccepted);
  CHECK_FALSE(rig.controller.Rebase(rig.home));
  rig.Seconds(0.15);
  rig.controller.Estop();
  CHECK_FALSE(rig.controller.Rebase(rig.home));
  rig.Seconds(1);
  CHECK(rig.controller.Rebase(rig.home));
  CHECK(rig.controller.q_ref() == rig.home);
  CHECK(rig.Status().state == ArmState::kStopped);
  CHECK(rig.Status().session == kA);
}

TEST_CASE("Commands that come late, bunched or at 250 Hz are followed as evenly as those that come on time") {
  std::mt19937 random(4);
  for (const int kind : {0, 1, 2, 3}) {  // 25 Hz; with jitter of a tick; every other one 3 ticks late; 250 Hz
    Rig rig;
    double least = 1, most = 0;
    int next = 0;
    int64_t seq = 0;
    const int period = kind == 3 ? 1 : 10;
    for (int tick = 0; tick < 500; ++tick) {
      if (tick >= next) {
        // Where the sender is at its own time.
        ++seq;
        (void)rig.Send(rig.Command(kA, seq, 0.1 + 0.3 * 0.004 * period * static_cast<double>(seq)));
        const int late = kind == 1 ? static_cast<int>(random() % 2) : kind == 2 && seq % 2 == 1 ? 3 : 0;
        next = static_cast<int>(seq) * period + late;
      }
      rig.Tick();
      if (tick < 150) continue;
      least = std::min(least, rig.controller.dq_ref()[0]);
      most = std::max(most, rig.controller.dq_ref()[0]);
    }
    INFO("kind " << kind);
    const double uneven = kind == 2 ? 0.2 : kind == 1 ? 0.1 : 0.01;
    CHECK(least > 0.3 * (1 - uneven));
    CHECK(most < 0.3 * (1 + uneven));
  }
}

TEST_CASE("A tick's record says what the controller did, one number a column") {
  Rig rig;
  (void)rig.Send(rig.Command(kA, 3, 0.4));
  (void)rig.Send(rig.Command(kB, 3, 0.4));
  rig.Seconds(0.1);
  TickRecord record;
  rig.controller.FillRecord(record);
  CHECK(record.utime == rig.now);
  CHECK(record.last_command_seq == 3);
  CHECK(record.state == static_cast<int8_t>(ArmState::kTracking));
  CHECK(record.q_target[0] == 0.4);
  CHECK(record.q_ref[0] == rig.controller.q_ref()[0]);
  CHECK(record.dq_ref[0] == rig.controller.dq_ref()[0]);
  CHECK(record.ddq_ref[0] == rig.controller.ddq_ref()[0]);
  CHECK(record.refused == 1);
  char row[4096];
  const int n = FormatTickRecord(record, row, sizeof row);
  CHECK(n == static_cast<int>(std::strlen(row)));
  const std::string header = kTickRecordHeader, text = row;
  CHECK(std::count(header.begin(), header.end(), ',') == std::count(text.begin(), text.end(), ','));
  char small[20];
  (void)FormatTickRecord(record, small, sizeof small);  // cut, not overrun
  CHECK(std::strlen(small) == sizeof small - 1);
}

TEST_CASE("A tick and a command do not allocate") {
  if (!AllocationHookActive()) {
    WARN("skipped: sanitizers own the allocator");
    return;
  }
  REQUIRE(AllocationHookSeesAll());
  Rig rig;
  ArmStatus status;
  TickRecord record;
  const AllocationCounter counter;
  for (int i = 0; i < 1000; ++i) {
    (void)rig.Send(rig.Command(kA, i / 2, i % 7 == 0 ? -2.0 : 2.5));
    rig.Tick(1 + i % 60);
    rig.controller.FillStatus(status);
    rig.controller.FillRecord(record);
    if (i % 50 == 0) rig.controller.Estop();
    if (i % 50 == 5) rig.controller.ResetFault(kA);
  }
  const auto n = counter.count();
  CHECK(n == 0);
}

}  // namespace intabs
