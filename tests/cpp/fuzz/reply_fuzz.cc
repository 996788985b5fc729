// libFuzzer target: what comes out of the control port, to the client, and what goes in, to the fake arm.
#include <cstdlib>

#include "intabs/lite6/fake_arm.h"
#include "intabs/lite6/wire.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace intabs;
  using namespace intabs::lite6;
  FakeArm arm(JointVector::Zero());
  while (size > 0) {
    FrameView frame;
    size_t used = 0;
    if (ParseFrame(data, size, frame, used) != Parsed::kFrame) break;
    if (used == 0 || used > size || frame.size < 0 || frame.body + frame.size != data + used) std::abort();
    Reply reply;
    if (ReadReply(frame, frame.reg, frame.tid, frame.protocol, reply) == ReplyFit::kOurs) {
      for (int what = 0; what <= 4; ++what) {
        JointVector q = JointVector::Zero(), dq = q, tau = q;
        if (ReadJoints(reply, what, q, dq, tau) && !(q.allFinite() && dq.allFinite() && tau.allFinite())) std::abort();
      }
    }
    Frame answer;
    arm.Handle(frame, answer);
    arm.Tick();
    if (!arm.q_ref().allFinite()) std::abort();
    FrameView twin;
    size_t twin_used = 0;
    if (ParseFrame(answer.bytes.data(), static_cast<size_t>(answer.size), twin, twin_used) != Parsed::kFrame) std::abort();
    if (ReadReply(twin, frame.reg, frame.tid, frame.protocol, reply) == ReplyFit::kBroken) std::abort();
    data += used;
    size -= used;
  }
  return 0;
}
