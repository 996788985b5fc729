#include "intabs/sim/arm_sim.h"

namespace intabs {

ArmSim::ArmSim(const std::string& models_dir, const std::string& task)
    : world_(models_dir, task), controller_(ArmLimits{}, ArmModel::Lite6()) {
  Reset(0, 0);
}

void ArmSim::Reset(int64_t seed, double spread_cm, int64_t now_us) {
  world_.Reset(seed, spread_cm);
  controller_.Reset(world_.Arm().q, now_us);
  ticks_ = 0;
}

void ArmSim::Tick(int64_t now_us) {
  controller_.Tick(now_us);
  world_.Step({controller_.q_ref(), controller_.dq_ref(), controller_.gripper_closed()});
  ++ticks_;
}

void ArmSim::Status(ArmStatus& s) const {
  const ArmMeasurement arm = world_.Arm();
  s.utime = world_.time_us();
  s.seq = ticks_ + 1;
  s.q = arm.q;
  s.dq = arm.dq;
  s.tau = arm.tau;
  s.gripper_opening = arm.gripper_opening;
  controller_.FillStatus(s);
}

void FillTruth(const World& world, PlantTruth& t) {
  t.utime = world.time_us();
  t.objects = world.Objects();
  t.subgoals = world.Subgoals();
  t.success = world.Success();
  t.state_hash = world.StateHash();
  const Contacts contacts = world.Touches();
  t.touches = contacts.touches;
  t.beads_in = contacts.beads_in;
  t.beads = contacts.beads;
}

void ArmSim::Truth(PlantTruth& t) const { FillTruth(world_, t); }

}  // namespace intabs
