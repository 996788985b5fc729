#include "intabs/lite6/wire.h"

#include <catch2/catch.hpp>
#include <cmath>
#include <cstring>
#include <string>
#include <vector>

#include "intabs/lite6/errors.h"
#include "intabs/lite6/report.h"

namespace intabs::lite6 {
namespace {

// Bytes behind the tid, as hex.
std::string Hex(const Request& request, uint16_t protocol = kHeartbeatProtocol) {
  Frame frame;
  EncodeRequest(request, 1, protocol, frame);
  std::string text;
  for (int i = 2; i < frame.size; ++i) {
    char byte[3];
    std::snprintf(byte, sizeof(byte), "%02x", frame.bytes[static_cast<size_t>(i)]);
    text += byte;
  }
  return text;
}

JointVector GoldenJoints() { return (JointVector() << .1, -.2, .3, -.4, .5, -.6).finished(); }

std::vector<uint8_t> Report(ReportKind kind) {
  ArmReport r;
  r.kind = kind;
  r.mode = VendorMode::kServo;
  r.state = VendorState::kSleeping;
  r.queued = 258;
  r.q = GoldenJoints();
  r.dq = 2 * GoldenJoints();
  r.tau = 3 * GoldenJoints();
  r.error = 31;
  r.warning = 11;
  r.enabled = 0x3f;
  std::vector<uint8_t> bytes(kMaxReportBytes);
  bytes.resize(static_cast<size_t>(EncodeReport(r, 123, GoldenJoints(), bytes.data())));
  return bytes;
}

}  // namespace

// Frames recorded from xarm-python-sdk 1.18.4.
TEST_CASE("Requests are those of the vendor's client, byte for byte") {
  CHECK(Hex(Request::Bare(Register::kGetVersion), kPlainProtocol) == "0002000101");
  CHECK(Hex(Request::MotionEnable(true)) == "000300030b0801");
  CHECK(Hex(Request::SetMode(VendorMode::kServo)) == "00030003130100");
  CHECK(Hex(Request::SetMode(VendorMode::kTeach)) == "00030003130200");
  CHECK(Hex(Request::SetState(VendorState::kReady)) == "000300020c00");
  CHECK(Hex(Request::SetState(VendorState::kStopped)) == "000300020c04");
  CHECK(Hex(Request::GetJoints(3)) == "000300022a03");
  CHECK(Hex(Request::ServoJ(GoldenJoints())) ==
        "000300291dcdcccc3dcdcc4cbe9a99993ecdccccbe0000003f9a9919bf00000000c2b8b23e58a00b4100000000");
  CHECK(Hex(Request::VelocityJ(GoldenJoints(), false, .1)) ==
        "0003002251cdcccc3dcdcc4cbe9a99993ecdccccbe0000003f9a9919bf0000000000cdcccc3d");
  CHECK(Hex(Request::SetToolOutput(0, true)) == "000300097f090a150080804300");
  CHECK(Hex(Request::SetToolOutput(1, false)) == "000300097f090a150000004400");
  CHECK(Hex(Request::SetToolOutput(0, false)) == "000300097f090a150000804300");
  CHECK(Hex(Request::SetToolOutput(1, true)) == "000300097f090a150080004400");
  CHECK(Hex(Request::Bare(Register::kCleanError)) == "0003000110");
  CHECK(Hex(Request::Bare(Register::kCleanWarning)) == "0003000111");
  CHECK(Hex(Request::SetLinearSpeedFactor(1.2)) == "00030006e8019a99993f");
  CHECK(Hex(Request::SetLoad(0, {0, 0, 0})).substr(0, 10) == "0003001124");
}

TEST_CASE("The header of a request holds its number") {
  Frame frame;
  EncodeRequest(Request::Bare(Register::kGetState), 0xfedc, kHeartbeatProtocol, frame);
  CHECK(frame.size == 7);
  CHECK(GetU16(frame.bytes.data()) == 0xfedc);
}

TEST_CASE("A frame is found however the stream is cut") {
  Frame frame;
  EncodeRequest(Request::ServoJ(GoldenJoints()), 7, kHeartbeatProtocol, frame);
  FrameView view;
  size_t used = 0;
  for (int n = 0; n < frame.size; ++n) {
    const std::vector<uint8_t> part(frame.bytes.begin(), frame.bytes.begin() + n);  // exact, so that ASan would see
    CHECK(ParseFrame(part.data(), part.size(), view, used) == Parsed::kMore);
  }
  REQUIRE(ParseFrame(frame.bytes.data(), static_cast<size_t>(frame.size) + 5, view, used) == Parsed::kFrame);
  CHECK(used == static_cast<size_t>(frame.size));
  CHECK((view.tid == 7 && view.reg == Register::kServoJ && view.size == 40));
}

TEST_CASE("What cannot be a frame breaks the connection at once") {
  FrameView view;
  size_t used = 0;
  const uint8_t wrong_protocol[] = {0, 1, 0, 9, 0, 2, 13, 0}, empty[] = {0, 1, 0, 3, 0, 0, 13},
                endless[] = {0, 1, 0, 3, 0xff, 0xff, 13};
  CHECK(ParseFrame(wrong_protocol, sizeof(wrong_protocol), view, used) == Parsed::kBroken);
  CHECK(ParseFrame(empty, sizeof(empty), view, used) == Parsed::kBroken);
  CHECK(ParseFrame(endless, sizeof(endless), view, used) == Parsed::kBroken);
}

TEST_CASE("A reply belongs to the request of its number, protocol and register") {
  const uint8_t body[] = {kStatusWarning, 2};
  FrameView frame{7, kHeartbeatProtocol, Register::kGetState, body, 2};
  Reply reply;
  CHECK(ReadReply(frame, Register::kGetState, 7, kHeartbeatProtocol, reply) == ReplyFit::kOurs);
  CHECK((reply.status == kStatusWarning && reply.size == 1 && reply.payload[0] == 2 && !reply.error()));
  CHECK(ReadReply(frame, Register::kGetState, 8, kHeartbeatProtocol, reply) == ReplyFit::kIgnored);
  CHECK(ReadReply(frame, Register::kGetError, 7, kHeartbeatProtocol, reply) == ReplyFit::kBroken);
  CHECK(ReadReply(frame, Register::kGetState, 7, kPlainProtocol, reply) == ReplyFit::kBroken);
  frame.size = 0;
  CHECK(ReadReply(frame, Register::kGetState, 7, kHeartbeatProtocol, reply) == ReplyFit::kBroken);
  frame.reg = Register::kFeedback;
  CHECK(ReadReply(frame, Register::kGetState, 7, kHeartbeatProtocol, reply) == ReplyFit::kIgnored);
}

TEST_CASE("Joint values that no arm has are refused and leave everything as it was") {
  uint8_t payload[84];
  for (int i = 0; i < 3; ++i) PutJointVector(payload + 28 * i, (i + 1) * GoldenJoints());
  const Reply reply{0, payload, 84}, cut{0, payload, 83};
  JointVector q, dq, tau;
  REQUIRE(ReadJoints(reply, 3, q, dq, tau));
  CHECK(q.isApprox(GoldenJoints(), 1e-7));
  CHECK(dq.isApprox(2 * GoldenJoints(), 1e-7));
  CHECK(tau.isApprox(3 * GoldenJoints(), 1e-7));
  const JointVector before = q;
  CHECK_FALSE(ReadJoints(cut, 3, q, dq, tau));
  for (const double bad : {std::nan(""), double(INFINITY), 14.0, -1e30}) {
    PutFloat(payload + 8, bad);
    CHECK_FALSE(ReadJoints(reply, 1, q, dq, tau));
    CHECK(q == before);
  }
}

TEST_CASE("Reports of every kind are read as they were written, however the stream is cut") {
  for (const ReportKind kind : {ReportKind::kReal, ReportKind::kNormal, ReportKind::kRich, ReportKind::kFull}) {
    const std::vector<uint8_t> bytes = Report(kind);
    ArmReport r;
    size_t used = 0;
    for (size_t n = 0; n < bytes.size(); ++n) {
      const std::vector<uint8_t> part(bytes.begin(), bytes.begin() + static_cast<ptrdiff_t>(n));
      REQUIRE(ParseReport(part.data(), part.size(), r, used) == Parsed::kMore);
    }
    REQUIRE(ParseReport(bytes.data(), bytes.size(), r, used) == Parsed::kFrame);
    CHECK(used == bytes.size());
    CHECK((r.kind == kind && r.mode == VendorMode::kServo && r.state == VendorState::kSleeping && r.queued == 258));
    CHECK(r.q.isApprox(GoldenJoints(), 1e-7));
    CHECK(r.tau.isApprox(3 * GoldenJoints(), 1e-7));
    CHECK(r.has_dq == (kind == ReportKind::kFull));
    if (r.has_dq) CHECK(r.dq.isApprox(2 * GoldenJoints(), 1e-7));
    CHECK(r.has_errors == (kind == ReportKind::kNormal || kind == ReportKind::kRich));
    if (r.has_errors) CHECK((r.error == 31 && r.warning == 11 && r.enabled == 0x3f));
  }
}

// Offsets as in the vendor's x3/report.py.
TEST_CASE("Reports have the vendor's layout") {
  const std::vector<uint8_t> real = Report(ReportKind::kReal), full = Report(ReportKind::kFull);
  CHECK((real.size() == 87 && Report(ReportKind::kNormal).size() == 145 && Report(ReportKind::kRich).size() == 587));
  CHECK(full.size() == 804);
  CHECK((GetU32(real.data()) == 87 && real[4] == 0x12 && GetU16(&real[5]) == 258));
  CHECK(GetFloat(&real[7]) == Approx(.1));
  CHECK(GetFloat(&real[59]) == Approx(.3));
  CHECK((GetU32(&full[8]) == 123 && full[12] == 0x12));
  CHECK((GetFloat(&full[32]) == Approx(.1) && GetFloat(&full[116]) == Approx(.1)));
  CHECK((GetFloat(&full[144]) == Approx(.2) && GetFloat(&full[228]) == Approx(.3)));
}

TEST_CASE("Nonsense in a report breaks it: sizes, modes, states, sensitivities, numbers") {
  const auto broken = [](ReportKind kind, size_t at, std::vector<uint8_t> bytes_there) {
    std::vector<uint8_t> bytes = Report(kind);
    std::copy(bytes_there.begin(), bytes_there.end(), bytes.begin() + static_cast<ptrdiff_t>(at));
    ArmReport r;
    size_t used = 0;
    return ParseReport(bytes.data(), bytes.size(), r, used) == Parsed::kBroken;
  };
  const std::vector<uint8_t> nan = {0, 0, 0xc0, 0x7f}, huge = {0, 0, 0, 0x7f};
  for (const uint8_t size : {0, 4, 86, 88, 134, 232}) CHECK(broken(ReportKind::kReal, 0, {0, 0, 0, size}));
  CHECK(broken(ReportKind::kReal, 0, {0, 0, 0x08, 0x01}));
  CHECK(broken(ReportKind::kReal, 0, {0xff, 0xff, 0xff, 0xff}));
  CHECK(broken(ReportKind::kReal, 4, {0xc2}));   // mode 12
  CHECK(broken(ReportKind::kReal, 4, {0x1a}));   // state 10
  CHECK_FALSE(broken(ReportKind::kReal, 4, {0xb9}));
  CHECK(broken(ReportKind::kFull, 12, {0xc2}));
  for (const auto& number : {nan, huge}) {
    CHECK(broken(ReportKind::kReal, 7 + 5 * 4, number));
    CHECK(broken(ReportKind::kReal, 59, number));
    CHECK(broken(ReportKind::kFull, 116, number));
    CHECK(broken(ReportKind::kFull, 144, number));
    CHECK(broken(ReportKind::kFull, 228, number));
  }
  CHECK(broken(ReportKind::kNormal, 131, {6}));
  CHECK(broken(ReportKind::kRich, 132, {6}));
}

TEST_CASE("Every error and warning of the vendor has a name, a cause and a cure") {
  for (const int code : {1,  2,  3,  10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 21, 22, 23, 24, 25, 26,  27, 28, 30, 31,
                         32, 33, 34, 35, 36, 37, 38, 39, 40, 41, 42, 50, 51, 52, 53, 60, 110, 111}) {
    const VendorCode& e = DescribeError(code);
    INFO(code);
    CHECK(e.code == code);
    CHECK((std::strlen(e.name) > 3 && std::strlen(e.cause) > 10 && std::strlen(e.cure) > 5));
  }
  for (const int code : {11, 12, 13, 14, 15}) CHECK(DescribeWarning(code).code == code);
  CHECK(ErrorLine(24).substr(0, 24) == "C24 speed exceeds limit:");
  CHECK(ErrorLine(199).find("unknown") != std::string::npos);
  CHECK(WarningLine(99).find("unknown") != std::string::npos);
}

}  // namespace intabs::lite6
