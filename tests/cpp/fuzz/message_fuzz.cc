// libFuzzer target: whatever comes as a datagram, and what the loop then does with it. One kind of message a run, the one
// that the environment names: INTABS_MESSAGE=ArmCommand.
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <map>
#include <string>

#include "../../../cpp/apps/intabs_control/plan_receiver.h"
#include "intabs/bus/bus.h"
#include "intabs/control/arm_controller.h"

namespace intabs {
namespace {

void Demand(bool ok) {
  if (!ok) std::abort();
}

template <class M>
void Use(const M&) {}

void Use(const ArmCommand& c) {
  static const ArmController fresh = [] {
    ArmController a(ArmLimits{}, ArmModel::Lite6());
    JointVector home;
    home << 0, -0.0163937938, 0.7773193333, 0, 0.7937131272, 0;
    a.Reset(home, 1);
    return a;
  }();
  ArmController arm = fresh;
  (void)arm.Accept(c, 1000);
  for (int i = 1; i <= 3; ++i) arm.Tick(4000 * i);
  Demand(arm.q_ref().allFinite() && (arm.q_ref() - fresh.q_ref()).cwiseAbs().maxCoeff() < 1e-3);
}

void Use(const ArmStatus& s) {
  Demand(s.q.allFinite() && s.dq.allFinite() && s.q_commanded.allFinite() && s.tau.allFinite());
}

void Use(const ObjectPoses& p) {
  for (const TrackedObject& o : p.objects) Demand(o.X_WO.IsFinite());
}

void Use(const PlantTruth& t) { Use(PosesFromTruth(t)); }

void Use(const SkillPlan& part) {
  PlanReceiver plan;
  SkillPlan other = part;
  other.part = 0;
  const bool complete = plan.Add(part);
  Demand(!complete || part.parts == 1);
  if (plan.Add(other)) Demand(plan.id() == part.plan_id && plan.skills().size() <= kMaxSkills);
}

// What was accepted survives the way back and is accepted again.
template <class M>
void Try(const uint8_t* data, size_t size) {
  M m;
  if (!Decode(data, size, m)) return;
  uint8_t bytes[kMaxMessageBytes], again[kMaxMessageBytes];
  const int n = Encode(m, bytes);
  M twin;
  Demand(n > 0 && Decode(bytes, static_cast<size_t>(n), twin));
  Demand(Encode(twin, again) == n);
  Use(m);
}

const std::map<std::string, void (*)(const uint8_t*, size_t)> kKinds = {
    {"ArmCommand", &Try<ArmCommand>},
    {"ArmStatus", &Try<ArmStatus>},
    {"Estop", &Try<Estop>},
    {"HandKeypoints", &Try<HandKeypoints>},
    {"LoopStatus", &Try<LoopStatus>},
    {"ObjectPoses", &Try<ObjectPoses>},
    {"PerceptionStatus", &Try<PerceptionStatus>},
    {"PlantControl", &Try<PlantControl>},
    {"PlantTruth", &Try<PlantTruth>},
    {"Reset", &Try<Reset>},
    {"SkillControl", &Try<SkillControl>},
    {"SkillPlan", &Try<SkillPlan>},
    {"SkillStatus", &Try<SkillStatus>},
    {"TagDetections", &Try<TagDetections>},
};

}  // namespace
}  // namespace intabs

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  static const auto try_one = [] {
    const char* name = std::getenv("INTABS_MESSAGE");
    const auto kind = intabs::kKinds.find(name != nullptr ? name : "");
    if (kind == intabs::kKinds.end()) {
      std::fprintf(stderr, "message_fuzz: INTABS_MESSAGE must name a message\n");
      std::exit(2);
    }
    return kind->second;
  }();
  try_one(data, size);
  return 0;
}
