#include "intabs/plant/world.h"

#include <mujoco/mujoco.h>

#include <algorithm>
#include <cstring>
#include <mutex>
#include <stdexcept>
#include <utility>

#include "intabs/plant/task.h"

namespace intabs {
namespace {

constexpr double kServoLead = 0.02;   // kv / kp of the servos [s]
constexpr double kGripperForce = 10;  // [N]
constexpr double kOpen = 0.0089;      // of a finger [m]
constexpr int kPhysicsSteps = 2;      // a driver tick
constexpr int kSettleSteps = 200;     // physics steps until beads lie still
constexpr double kBeadGrid = 0.0105;  // [m], a little over a bead's diameter

// MuJoCo 2.2.2's box against box: where they lie on each other at a distance of zero, as after a reset, rounding makes it
// now and then report contacts half a metre deep, which throw the object. Nothing goes deeper into a box than it is thick.
mjfCollision box_box = nullptr;
int TrueBoxContacts(const mjModel* m, const mjData* d, mjContact* contacts, int g1, int g2, mjtNum margin) {
  const mjtNum* a = m->geom_size + 3 * g1;
  const mjtNum* b = m->geom_size + 3 * g2;
  const mjtNum thickness = 2 * std::min({a[0], a[1], a[2], b[0], b[1], b[2]});
  mjContact* end = contacts + box_box(m, d, contacts, g1, g2, margin);
  return static_cast<int>(
      std::remove_if(contacts, end, [&](const mjContact& c) { return c.dist < -thickness; }) - contacts);
}

// MuJoCo's own handlers write MUJOCO_LOG.TXT where they stand, and an error waits for the Enter key.
void InstallHandlers() {
  static std::once_flag once;
  std::call_once(once, [] {
    mju_user_warning = [](const char*) {};  // Step() looks at mjData::warning
    mju_user_error = [](const char* text) { throw std::runtime_error(std::string("MuJoCo: ") + text); };
    box_box = std::exchange(mjCOLLISIONFUNC[mjGEOM_BOX][mjGEOM_BOX], &TrueBoxContacts);
  });
}

std::string ScenePath(const std::string& models_dir, const std::string& task) {
  return models_dir + "/scenes/" + task + ".xml";
}

std::shared_ptr<mjModel> LoadModel(const std::string& path) {
  InstallHandlers();
  char error[1000] = "";
  mjModel* m = mj_loadXML(path.c_str(), nullptr, error, sizeof(error));
  if (m == nullptr) {
    std::string line = path + ": " + error;  // MuJoCo likes several
    while (!line.empty() && line.back() == '\n') line.pop_back();
    std::replace(line.begin(), line.end(), '\n', ' ');
    throw std::runtime_error(line);
  }
  return {m, mj_deleteModel};
}

Pose PoseOf(const mjtNum* p, const mjtNum* q) { return {{p[0], p[1], p[2]}, {q[0], q[1], q[2], q[3]}}; }

void SetPose(const Pose& X, mjtNum* p, mjtNum* q) {
  for (int k = 0; k < 3; ++k) p[k] = X.p[k];
  q[0] = X.q.w();
  q[1] = X.q.x();
  q[2] = X.q.y();
  q[3] = X.q.z();
}

bool IsFree(const mjModel* m, int body) {
  const int j = m->body_jntadr[body];
  return j >= 0 && m->jnt_type[j] == mjJNT_FREE;
}

bool Overlap(const std::vector<Disc>& a, const Pose& X_WA, const std::vector<Disc>& b, const Pose& X_WB) {
  for (const Disc& da : a) {
    const Eigen::Vector3d pa = X_WA * Eigen::Vector3d(da.x, da.y, 0);
    for (const Disc& db : b) {
      const Eigen::Vector3d pb = X_WB * Eigen::Vector3d(db.x, db.y, 0);
      if ((pa - pb).head<2>().norm() <= da.radius + db.radius) return true;
    }
  }
  return false;
}

}  // namespace

JointVector World::Home() {
  return (JointVector() << 0, -0.0163937938, 0.7773193333, 0, 0.7937131272, 0).finished();
}

World::World(const std::string& models_dir, const std::string& task)
    : task_(MakeTask(task)),
      model_(LoadModel(ScenePath(models_dir, task))),
      data_(mj_makeData(model_.get()), mj_deleteData) {
  const mjModel* m = model_.get();
  const std::string path = ScenePath(models_dir, task);
  const auto find = [&](mjtObj type, const std::string& name) {
    const int id = mj_name2id(m, type, name.c_str());
    if (id < 0) throw std::runtime_error(path + ": has no " + mju_type2Str(type) + " \"" + name + "\"");
    return id;
  };
  for (int i = 0; i < kNumJoints; ++i) {
    const std::string name = "joint" + std::to_string(i + 1);
    const int j = find(mjOBJ_JOINT, name);
    joint_qpos_[i] = m->jnt_qposadr[j];
    joint_dof_[i] = m->jnt_dofadr[j];
    joint_actuator_[i] = find(mjOBJ_ACTUATOR, name);
    compensated_dofs_.push_back(joint_dof_[i]);
  }
  const std::array<std::string, 2> fingers = {"finger_left", "finger_right"};
  for (int i = 0; i < 2; ++i) {
    const int j = find(mjOBJ_JOINT, fingers[i]);
    finger_qpos_[i] = m->jnt_qposadr[j];
    compensated_dofs_.push_back(m->jnt_dofadr[j]);
  }
  gripper_actuator_ = find(mjOBJ_ACTUATOR, "gripper");
  // Scenes with many bodies ask for Euler, which is cheaper. It treats the damping of joints implicitly, of actuators
  // not: with that the servos would chatter.
  if (m->opt.integrator == mjINT_EULER) {
    for (int i = 0; i < kNumJoints; ++i) {
      mjtNum& minus_kv = model_->actuator_biasprm[mjNBIAS * joint_actuator_[i] + 2];
      servo_damping_[i] = -minus_kv;
      model_->dof_damping[joint_dof_[i]] -= minus_kv;
      model_->actuator_forcelimited[joint_actuator_[i]] = 0;  // PhysicsStep limits the sum
      minus_kv = 0;
    }
  }
  for (const TaskObject& o : task_->objects()) {
    const int body = find(mjOBJ_BODY, o.body);
    const int placed = o.base.empty() ? body : find(mjOBJ_BODY, o.base);
    if (m->body_mocapid[placed] < 0 && !(o.base.empty() && IsFree(m, body))) {
      throw std::runtime_error(path + ": body \"" + (o.base.empty() ? o.body : o.base) +
                               (o.base.empty() ? "\" must have a freejoint or be a mocap body"
                                               : "\" must be a mocap body: it carries " + o.body));
    }
  }
  for (int b = 0; b < m->nbody; ++b) {
    if (std::strncmp(m->names + m->name_bodyadr[b], "bead", 4) == 0) beads_.push_back(b);
  }
  if (!task_->beads_in().empty()) find(mjOBJ_SITE, task_->beads_in() + "_inside");
  Reset(0, 0);
}

World::~World() = default;

void World::Reset(int64_t seed, double spread_cm) {
  if (!(spread_cm >= 0 && spread_cm <= kMaxSpread)) {  // NaN too
    throw std::runtime_error("spread of " + std::to_string(spread_cm) + " cm; give 0 to " +
                             std::to_string(static_cast<int>(kMaxSpread)));
  }
  const mjModel* m = model_.get();
  mjData* d = data_.get();
  mj_resetData(m, d);
  ticks_ = 0;
  gripper_closed_ = false;
  const JointVector home = Home();
  for (int i = 0; i < kNumJoints; ++i) {
    d->qpos[joint_qpos_[i]] = home[i];
    d->ctrl[joint_actuator_[i]] = home[i];
  }
  for (const int a : finger_qpos_) d->qpos[a] = kOpen;
  d->ctrl[gripper_actuator_] = kGripperForce;

  // Drawn again as a whole until no two objects are in each other's way.
  Random random(static_cast<uint64_t>(seed));
  const std::vector<TaskObject> objects = task_->objects();
  const std::vector<Disc> kept_free = task_->kept_free();
  const double spread = 0.01 * spread_cm, yaw_limit = std::min(3.0 * spread_cm, 30.0) * M_PI / 180;
  std::vector<Pose> poses(objects.size());
  for (bool clear = false; !clear;) {
    for (size_t i = 0; i < objects.size(); ++i) {
      const TaskObject& o = objects[i];
      const double r = spread * std::sqrt(random.Uniform(0, 1)), a = random.Uniform(-M_PI, M_PI);
      poses[i].p << o.radius * std::cos(o.azimuth) + r * std::cos(a),
          o.radius * std::sin(o.azimuth) + r * std::sin(a), o.height;
      poses[i].q = ExpSO3({0, 0, o.azimuth + o.turn + random.Uniform(-yaw_limit, yaw_limit)});
    }
    clear = true;
    for (size_t i = 0; i < poses.size(); ++i) {
      const std::vector<Disc>& footprint = objects[i].footprint;
      clear = clear && !Overlap(footprint, poses[i], kept_free, Pose{});
      for (size_t j = 0; j < i; ++j) clear = clear && !Overlap(footprint, poses[i], objects[j].footprint, poses[j]);
    }
  }
  Place(poses);
  if (!task_->beads_in().empty()) {
    FillVessel(mj_name2id(m, mjOBJ_SITE, (task_->beads_in() + "_inside").c_str()));
    for (int k = 0; k < kSettleSteps; ++k) PhysicsStep();
    for (int i = 0; i < kNumJoints; ++i) d->qpos[joint_qpos_[i]] = home[i];
    for (const int a : finger_qpos_) d->qpos[a] = kOpen;
    mju_zero(d->qvel, m->nv);
    mju_zero(d->qacc_warmstart, m->nv);
    d->time = 0;
  }
  mj_forward(m, d);
  task_->Restart();
}

// Sets what the seed moves to its pose in W, in the order of the task's objects.
void World::Place(const std::vector<Pose>& poses) {
  const mjModel* m = model_.get();
  mjData* d = data_.get();
  const std::vector<TaskObject> objects = task_->objects();
  for (size_t i = 0; i < objects.size(); ++i) {
    const TaskObject& o = objects[i];
    const int body = mj_name2id(m, mjOBJ_BODY, o.body.c_str());
    mjtNum* free = IsFree(m, body) ? d->qpos + m->jnt_qposadr[m->body_jntadr[body]] : nullptr;
    const int placed = o.base.empty() ? body : mj_name2id(m, mjOBJ_BODY, o.base.c_str());
    if (const int mocap = m->body_mocapid[placed]; mocap >= 0) {
      SetPose(poses[i], d->mocap_pos + 3 * mocap, d->mocap_quat + 4 * mocap);
    }
    if (!free) continue;
    Pose X = poses[i];
    if (!o.base.empty()) {
      const auto in_file = [m](int b) { return PoseOf(m->body_pos + 3 * b, m->body_quat + 4 * b); };
      X = X * in_file(placed).Inverse() * in_file(body);
    }
    SetPose(X, free, free + 3);
  }
}

void World::Nudge(int slot, const Eigen::Vector3d& dp_W) {
  const mjModel* m = model_.get();
  mjData* d = data_.get();
  for (const TaskObject& o : task_->objects()) {
    if (o.slot != slot) continue;
    const int body = mj_name2id(m, mjOBJ_BODY, o.body.c_str());
    const int placed = o.base.empty() ? body : mj_name2id(m, mjOBJ_BODY, o.base.c_str());
    if (IsFree(m, body)) {
      mju_addTo3(d->qpos + m->jnt_qposadr[m->body_jntadr[body]], dp_W.data());
    } else {
      mju_addTo3(d->mocap_pos + 3 * m->body_mocapid[placed], dp_W.data());
    }
    mj_forward(m, d);
    return;
  }
  throw std::runtime_error("no object in slot " + std::to_string(slot) + " to nudge");
}

// Beads in layers on the floor of a vessel: rings about its axis, not yet at rest.
void World::FillVessel(int site) {
  const mjModel* m = model_.get();
  mjData* d = data_.get();
  mj_kinematics(m, d);
  const int rings = static_cast<int>((m->site_size[3 * site] - 0.006) / kBeadGrid);
  size_t next = 0;
  for (double z = -m->site_size[3 * site + 1] + 0.5 * kBeadGrid; next < beads_.size(); z += kBeadGrid) {
    for (int ring = 0; ring <= rings; ++ring) {
      for (int k = 0; k < std::max(1, 6 * ring) && next < beads_.size(); ++k, ++next) {
        const double r = kBeadGrid * ring, a = 2 * M_PI * k / std::max(1, 6 * ring) + 100 * z;
        const mjtNum local[3] = {r * std::cos(a), r * std::sin(a), z};
        mjtNum p[3];
        mju_rotVecMat(p, local, d->site_xmat + 9 * site);
        mju_addTo3(p, d->site_xpos + 3 * site);
        const int body = beads_[next];
        mju_sub3(d->qpos + m->jnt_qposadr[m->body_jntadr[body]], p, m->body_pos + 3 * body);
      }
    }
  }
}

void World::PhysicsStep() {
  const mjModel* m = model_.get();
  mjData* d = data_.get();
  mj_step1(m, d);
  for (const int i : compensated_dofs_) d->qfrc_applied[i] = d->qfrc_bias[i];
  for (int i = 0; i < kNumJoints && servo_damping_[i] > 0; ++i) {
    const int a = joint_actuator_[i], dof = joint_dof_[i];
    const double torque = m->actuator_gainprm[mjNGAIN * a] * (d->ctrl[a] - d->qpos[joint_qpos_[i]]) -
                          servo_damping_[i] * d->qvel[dof];
    const double limited = std::clamp(torque, m->actuator_forcerange[2 * a], m->actuator_forcerange[2 * a + 1]);
    d->qfrc_applied[dof] -= torque - limited;
  }
  mj_step2(m, d);
}

struct World::View : TaskView {
  explicit View(const World& w) {
    model = w.model_.get();
    data = w.data_.get();
    gripper_closed = w.gripper_closed_;
  }
};

void World::Step(const ServoTarget& target) {
  // MuJoCo would set all its controls to zero and go on.
  if (!target.q.allFinite() || !target.dq.allFinite()) throw std::runtime_error("the servo target is not finite");
  const mjModel* m = model_.get();
  mjData* d = data_.get();
  gripper_closed_ = target.gripper_closed;
  for (int i = 0; i < kNumJoints; ++i) {
    d->ctrl[joint_actuator_[i]] = target.q[i] + kServoLead * target.dq[i];
  }
  d->ctrl[gripper_actuator_] = target.gripper_closed ? -kGripperForce : kGripperForce;
  for (int k = 0; k < kPhysicsSteps; ++k) PhysicsStep();
  for (int w = 0; w < mjNWARNING; ++w) {  // after most of them MuJoCo resets itself and goes on
    if (d->warning[w].number > 0) {
      throw std::runtime_error("the simulation broke down at " + std::to_string(d->time) + " s: " +
                               mju_warningText(w, d->warning[w].lastinfo));
    }
  }
  // What is read afterwards belongs to the new state.
  mj_kinematics(m, d);
  ++ticks_;
  task_->Watch(View(*this));
}

int64_t World::time_us() const { return ticks_ * kDriverPeriodUs; }

ArmMeasurement World::Arm() const {
  ArmMeasurement a;
  for (int i = 0; i < kNumJoints; ++i) {
    a.q[i] = data_->qpos[joint_qpos_[i]];
    a.dq[i] = data_->qvel[joint_dof_[i]];
    a.tau[i] = data_->qfrc_actuator[joint_dof_[i]] + data_->qfrc_applied[joint_dof_[i]] -
               servo_damping_[i] * a.dq[i];
  }
  a.gripper_opening = data_->qpos[finger_qpos_[0]] + data_->qpos[finger_qpos_[1]];
  return a;
}

std::array<TrackedObject, kMaxObjects> World::Objects() const {
  std::array<TrackedObject, kMaxObjects> out;
  const View view(*this);
  for (const TaskObject& o : task_->objects()) {
    out[o.slot].id = o.id;
    out[o.slot].X_WO = view.Body(o.body);
    out[o.slot].valid = true;
  }
  return out;
}

Contacts World::Touches() const {
  const mjModel* m = model_.get();
  const mjData* d = data_.get();
  const View view(*this);
  Contacts out;
  out.beads = static_cast<int16_t>(beads_.size());
  // What a body is for others: the bit of PlantTruth::touches.
  constexpr uint8_t kBead = 0;
  std::vector<uint8_t> bit(m->nbody, kTouchesScene);
  for (const int b : beads_) bit[b] = kBead;
  const int arm = m->body_rootid[mj_name2id(m, mjOBJ_BODY, "finger_left")];
  for (int b = 1; b < m->nbody; ++b) {
    if (m->body_rootid[b] == arm) bit[b] = kTouchesArm;
  }
  bit[mj_name2id(m, mjOBJ_BODY, "finger_left")] = kTouchesLeftFinger;
  bit[mj_name2id(m, mjOBJ_BODY, "finger_right")] = kTouchesRightFinger;
  std::vector<int> slot(m->nbody, -1);
  for (const TaskObject& o : task_->objects()) {
    const int b = mj_name2id(m, mjOBJ_BODY, o.body.c_str());
    slot[b] = o.slot;
    bit[b] = static_cast<uint8_t>(1 << o.slot);
    out.beads_in[o.slot] = static_cast<int16_t>(view.BeadsIn(o.body));
  }
  for (int i = 0; i < d->ncon; ++i) {
    const int a = m->geom_bodyid[d->contact[i].geom1], b = m->geom_bodyid[d->contact[i].geom2];
    if (slot[a] >= 0) out.touches[slot[a]] |= bit[b];
    if (slot[b] >= 0) out.touches[slot[b]] |= bit[a];
  }
  return out;
}

std::vector<std::string> World::SubgoalNames() const { return task_->subgoals(); }
uint32_t World::Subgoals() const { return task_->Subgoals(View(*this)); }
bool World::Success() const { return FailureReason().empty(); }
std::string World::FailureReason() const { return task_->Missing(View(*this)); }

uint64_t World::StateHash() const {
  uint64_t hash = 1469598103934665603ULL;  // FNV-1a
  const auto add = [&hash](const mjtNum* v, int n) {
    for (int i = 0; i < n; ++i) {
      uint64_t bits;
      std::memcpy(&bits, v + i, sizeof(bits));
      hash = (hash ^ bits) * 1099511628211ULL;
    }
  };
  add(data_->qpos, model_->nq);
  add(data_->qvel, model_->nv);
  add(data_->mocap_pos, 3 * model_->nmocap);
  add(data_->mocap_quat, 4 * model_->nmocap);
  return hash;
}

void World::Save(Snapshot& s) const {
  s.time = data_->time;
  s.qpos.assign(data_->qpos, data_->qpos + model_->nq);
  s.mocap_pos.assign(data_->mocap_pos, data_->mocap_pos + 3 * model_->nmocap);
  s.mocap_quat.assign(data_->mocap_quat, data_->mocap_quat + 4 * model_->nmocap);
}

}  // namespace intabs
