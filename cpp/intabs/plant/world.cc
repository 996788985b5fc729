#include "intabs/plant/world.h"

#include <mujoco/mujoco.h>

#include <algorithm>
#include <cstring>
#include <stdexcept>

#include "intabs/plant/task.h"

namespace intabs {
namespace {

constexpr double kServoLead = 0.02;   // kv / kp of the servos [s]
constexpr double kGripperForce = 10;  // [N]
constexpr double kOpen = 0.0089;      // of a finger [m]
constexpr double kClearance = 0.09;   // between objects at the start [m]
constexpr int kPhysicsSteps = 2;      // a driver tick

// MuJoCo's own handlers write MUJOCO_LOG.TXT where they stand, and an error waits for the Enter key.
void InstallHandlers() {
  mju_user_warning = [](const char*) {};  // Step() looks at mjData::warning
  mju_user_error = [](const char* text) { throw std::runtime_error(std::string("MuJoCo: ") + text); };
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

}  // namespace

JointVector World::Home() {
  return (JointVector() << 0, -0.0163937938, 0.7773193333, 0, 0.7937131272, 0).finished();
}

World::World(const std::string& models_dir, const std::string& task)
    : task_(FindTask(task)),
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
  for (const TaskObject& o : task_.objects()) {
    const int b = find(mjOBJ_BODY, o.body), j = m->body_jntadr[b];
    if (m->body_mocapid[b] < 0 && (j < 0 || m->jnt_type[j] != mjJNT_FREE)) {
      throw std::runtime_error(path + ": body \"" + o.body + "\" must have a freejoint or be a mocap body");
    }
  }
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
  const std::vector<TaskObject> objects = task_.objects();
  const double spread = 0.01 * spread_cm, yaw_limit = std::min(3.0 * spread_cm, 30.0) * M_PI / 180;
  std::vector<Pose> poses(objects.size());
  for (bool clear = false; !clear;) {
    for (size_t i = 0; i < objects.size(); ++i) {
      const TaskObject& o = objects[i];
      const double r = spread * std::sqrt(random.Uniform(0, 1)), a = random.Uniform(-M_PI, M_PI);
      poses[i].p << o.radius * std::cos(o.azimuth) + r * std::cos(a),
          o.radius * std::sin(o.azimuth) + r * std::sin(a), o.height;
      poses[i].q = ExpSO3({0, 0, o.azimuth + random.Uniform(-yaw_limit, yaw_limit)});
    }
    clear = true;
    for (size_t i = 0; i < poses.size(); ++i) {
      for (size_t j = 0; j < i; ++j) clear = clear && (poses[i].p - poses[j].p).head<2>().norm() > kClearance;
    }
  }
  for (size_t i = 0; i < objects.size(); ++i) {
    const int b = mj_name2id(m, mjOBJ_BODY, objects[i].body.c_str());
    const int mocap = m->body_mocapid[b];
    mjtNum* p = mocap >= 0 ? d->mocap_pos + 3 * mocap : d->qpos + m->jnt_qposadr[m->body_jntadr[b]];
    mjtNum* q = mocap >= 0 ? d->mocap_quat + 4 * mocap : p + 3;
    for (int k = 0; k < 3; ++k) p[k] = poses[i].p[k];
    q[0] = poses[i].q.w();
    q[1] = poses[i].q.x();
    q[2] = poses[i].q.y();
    q[3] = poses[i].q.z();
  }
  mj_forward(m, d);
}

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
  for (int k = 0; k < kPhysicsSteps; ++k) {
    mj_step1(m, d);
    for (const int i : compensated_dofs_) d->qfrc_applied[i] = d->qfrc_bias[i];
    mj_step2(m, d);
  }
  for (int w = 0; w < mjNWARNING; ++w) {  // after most of them MuJoCo resets itself and goes on
    if (d->warning[w].number > 0) {
      throw std::runtime_error("the simulation broke down at " + std::to_string(d->time) + " s: " +
                               mju_warningText(w, d->warning[w].lastinfo));
    }
  }
  // What is read afterwards belongs to the new state.
  mj_kinematics(m, d);
  ++ticks_;
}

int64_t World::time_us() const { return ticks_ * kDriverPeriodUs; }

ArmMeasurement World::Arm() const {
  ArmMeasurement a;
  for (int i = 0; i < kNumJoints; ++i) {
    a.q[i] = data_->qpos[joint_qpos_[i]];
    a.dq[i] = data_->qvel[joint_dof_[i]];
    a.tau[i] = data_->qfrc_actuator[joint_dof_[i]] + data_->qfrc_applied[joint_dof_[i]];
  }
  a.gripper_opening = data_->qpos[finger_qpos_[0]] + data_->qpos[finger_qpos_[1]];
  return a;
}

struct World::View : TaskView {
  explicit View(const World& w) {
    model = w.model_.get();
    data = w.data_.get();
    gripper_closed = w.gripper_closed_;
  }
};

std::array<TrackedObject, kMaxObjects> World::Objects() const {
  std::array<TrackedObject, kMaxObjects> out;
  const View view(*this);
  int slot = 0;
  for (const TaskObject& o : task_.objects()) {
    out[slot].id = o.id;
    out[slot].X_WO = view.Body(o.body);
    out[slot].valid = true;
    ++slot;
  }
  return out;
}

std::vector<std::string> World::SubgoalNames() const { return task_.subgoals(); }
uint32_t World::Subgoals() const { return task_.Subgoals(View(*this)); }
bool World::Success() const { return FailureReason().empty(); }
std::string World::FailureReason() const { return task_.Missing(View(*this)); }

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
  return hash;
}

void World::Save(Snapshot& s) const {
  s.time = data_->time;
  s.qpos.assign(data_->qpos, data_->qpos + model_->nq);
  s.mocap_pos.assign(data_->mocap_pos, data_->mocap_pos + 3 * model_->nmocap);
  s.mocap_quat.assign(data_->mocap_quat, data_->mocap_quat + 4 * model_->nmocap);
}

}  // namespace intabs
