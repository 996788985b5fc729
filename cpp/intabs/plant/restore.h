// Puts a Snapshot into MuJoCo data that only draws.
#pragma once

#include <mujoco/mujoco.h>

#include <algorithm>

#include "intabs/plant/world.h"

namespace intabs {

inline void Restore(const Snapshot& s, const mjModel* m, mjData* d) {
  std::copy(s.qpos.begin(), s.qpos.end(), d->qpos);
  std::copy(s.mocap_pos.begin(), s.mocap_pos.end(), d->mocap_pos);
  std::copy(s.mocap_quat.begin(), s.mocap_quat.end(), d->mocap_quat);
  d->time = s.time;
  mj_kinematics(m, d);
  mj_comPos(m, d);
  mj_camlight(m, d);
}

}  // namespace intabs
