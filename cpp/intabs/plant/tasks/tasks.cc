#include "intabs/plant/tasks/tasks.h"

#include <algorithm>
#include <cstring>
#include <sstream>
#include <stdexcept>

namespace intabs {

namespace {

struct Known {
  const char* name;
  std::unique_ptr<Task> (*make)();
};
constexpr Known kTasks[] = {
    {"pick_place", &MakePickPlace}, {"drawer_open", &MakeDrawerOpen}, {"box_open", &MakeBoxOpen},
    {"pour", &MakePour},            {"stir", &MakeStir},
};
constexpr const char* kCompositions[] = {"drawer_open+pick_place", "pour+stir", "box_open+pour"};

class Composition final : public Task {
 public:
  explicit Composition(std::vector<std::unique_ptr<Task>> parts) : parts_(std::move(parts)) {}

  std::vector<TaskObject> objects() const override {
    std::vector<TaskObject> all;
    for (const auto& part : parts_) {
      for (const TaskObject& o : part->objects()) {
        if (std::none_of(all.begin(), all.end(), [&](const TaskObject& a) { return a.body == o.body; }))
          all.push_back(o);
      }
    }
    return all;
  }
  std::vector<Disc> kept_free() const override {
    std::vector<Disc> all;
    for (const auto& part : parts_) {
      for (const Disc& d : part->kept_free()) all.push_back(d);
    }
    return all;
  }
  std::string beads_in() const override {
    for (const auto& part : parts_) {
      if (!part->beads_in().empty()) return part->beads_in();
    }
    return "";
  }
  std::vector<std::string> subgoals() const override {
    std::vector<std::string> all;
    for (const auto& part : parts_) {
      for (const std::string& name : part->subgoals()) all.push_back(name);
    }
    return all;
  }
  void Restart() override {
    for (const auto& part : parts_) part->Restart();
  }
  void Watch(const TaskView& view) override {
    for (const auto& part : parts_) part->Watch(view);
  }
  uint32_t Subgoals(const TaskView& view) const override {
    uint32_t bits = 0;
    size_t first = 0;
    for (const auto& part : parts_) {
      bits |= part->Subgoals(view) << first;
      first += part->subgoals().size();
    }
    return bits;
  }
  std::string Missing(const TaskView& view) const override {
    for (const auto& part : parts_) {
      if (std::string missing = part->Missing(view); !missing.empty()) return missing;
    }
    return "";
  }

 private:
  std::vector<std::unique_ptr<Task>> parts_;
};

}  // namespace

const std::vector<std::string>& TaskNames() {
  static const std::vector<std::string> names = [] {
    std::vector<std::string> all;
    for (const Known& task : kTasks) all.emplace_back(task.name);
    for (const char* name : kCompositions) all.emplace_back(name);
    return all;
  }();
  return names;
}

std::unique_ptr<Task> MakeTask(const std::string& name) {
  const std::vector<std::string>& known = TaskNames();
  if (std::find(known.begin(), known.end(), name) == known.end()) {
    std::string list;
    for (const std::string& n : known) list += (list.empty() ? "" : ", ") + n;
    throw std::runtime_error("unknown task \"" + name + "\"; known: " + list);
  }
  std::vector<std::unique_ptr<Task>> parts;
  std::istringstream text(name);
  for (std::string part; std::getline(text, part, '+');) {
    for (const Known& task : kTasks) {
      if (part == task.name) parts.push_back(task.make());
    }
  }
  return parts.size() == 1 ? std::move(parts[0]) : std::make_unique<Composition>(std::move(parts));
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

double TaskView::Upright(const std::string& name) const {
  return (Body(name).q * Eigen::Vector3d::UnitZ()).z();
}

double TaskView::Joint(const std::string& name) const {
  return data->qpos[model->jnt_qposadr[mj_name2id(model, mjOBJ_JOINT, name.c_str())]];
}
double TaskView::JointSpeed(const std::string& name) const {
  return data->qvel[model->jnt_dofadr[mj_name2id(model, mjOBJ_JOINT, name.c_str())]];
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

namespace {
bool IsBead(const mjModel* m, int body) { return std::strncmp(m->names + m->name_bodyadr[body], "bead", 4) == 0; }

// A point in the frame of a cylindrical site, and whether it is within.
Eigen::Vector3d InSite(const TaskView& v, int site, const mjtNum* p_W) {
  using Eigen::Map, Eigen::Vector3d;
  const Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>> R(v.data->site_xmat + 9 * site);
  return R.transpose() * (Map<const Vector3d>(p_W) - Map<const Vector3d>(v.data->site_xpos + 3 * site));
}
bool Within(const TaskView& v, int site, const Eigen::Vector3d& p) {
  const mjtNum* size = v.model->site_size + 3 * site;  // radius, half height
  return p.head<2>().norm() < size[0] && std::abs(p.z()) < size[1];
}
int FindSite(const TaskView& v, const std::string& name) { return mj_name2id(v.model, mjOBJ_SITE, name.c_str()); }
}  // namespace

int TaskView::Beads() const {
  int n = 0;
  for (int b = 0; b < model->nbody; ++b) n += IsBead(model, b);
  return n;
}

int TaskView::BeadsIn(const std::string& vessel) const {
  const int site = FindSite(*this, vessel + "_inside");
  if (site < 0) return 0;
  int n = 0;
  for (int b = 0; b < model->nbody; ++b) {
    n += IsBead(model, b) && Within(*this, site, InSite(*this, site, data->xpos + 3 * b));
  }
  return n;
}

Eigen::Vector3d TaskView::Tip(const std::string& body, const std::string& vessel) const {
  return InSite(*this, FindSite(*this, vessel + "_inside"), data->site_xpos + 3 * FindSite(*this, body + "_tip"));
}

bool TaskView::TipInside(const std::string& body, const std::string& vessel) const {
  return Within(*this, FindSite(*this, vessel + "_inside"), Tip(body, vessel));
}

}  // namespace intabs
