#include "intabs/plant/tasks/tasks.h"

#include <stdexcept>

namespace intabs {

const std::vector<const Task*>& Tasks() {
  static const std::vector<const Task*> tasks = {&PickPlaceTask()};
  return tasks;
}

const Task& FindTask(const std::string& name) {
  std::string known;
  for (const Task* task : Tasks()) {
    if (task->name() == name) return *task;
    known += (known.empty() ? "" : ", ") + task->name();
  }
  throw std::runtime_error("unknown task \"" + name + "\"; known: " + known);
}

Pose TaskView::Body(const std::string& name) const {
  const int b = mj_name2id(model, mjOBJ_BODY, name.c_str());
  const mjtNum* p = data->xpos + 3 * b;
  const mjtNum* q = data->xquat + 4 * b;
  return {{p[0], p[1], p[2]}, Eigen::Quaterniond(q[0], q[1], q[2], q[3])};
}

namespace {
Eigen::Matrix<double, 6, 1> Velocity(const TaskView& v, const std::string& name) {
  mjtNum velocity[6];  // angular, linear
  mj_objectVelocity(v.model, v.data, mjOBJ_BODY, mj_name2id(v.model, mjOBJ_BODY, name.c_str()), velocity, 0);
  return Eigen::Map<const Eigen::Matrix<double, 6, 1>>(velocity);
}
}  // namespace

double TaskView::LinearSpeed(const std::string& name) const { return Velocity(*this, name).tail<3>().norm(); }
double TaskView::AngularSpeed(const std::string& name) const {
  return Velocity(*this, name).head<3>().norm();
}

bool TaskView::FingersTouch(const std::string& name) const {
  const int body = mj_name2id(model, mjOBJ_BODY, name.c_str());
  const int fingers[2] = {mj_name2id(model, mjOBJ_BODY, "finger_left"),
                          mj_name2id(model, mjOBJ_BODY, "finger_right")};
  for (int i = 0; i < data->ncon; ++i) {
    const int a = model->geom_bodyid[data->contact[i].geom1], b = model->geom_bodyid[data->contact[i].geom2];
    for (const int finger : fingers) {
      if ((a == body && b == finger) || (b == body && a == finger)) return true;
    }
  }
  return false;
}

}  // namespace intabs
