#include <pybind11/eigen.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "intabs/sim/session.h"
#include "intabs/skills/kinematic_rollout.h"
#include "intabs/skills/skill_controller.h"
#include "intabs/skills/skill_library.h"

namespace py = pybind11;

namespace intabs {
namespace {

// What the demonstrator and rollouts see of a policy tick.
py::dict Observe(const Session& session) {
  py::array_t<double> pose({py::ssize_t{kMaxObjects}, py::ssize_t{7}});
  py::array_t<double> truth({py::ssize_t{kMaxObjects}, py::ssize_t{7}});
  py::array_t<float> covariance({py::ssize_t{kMaxObjects}, py::ssize_t{21}});
  py::array_t<bool> valid(kMaxObjects);
  py::array_t<float> age(kMaxObjects);
  const auto objects = session.world().Objects();
  for (int i = 0; i < kMaxObjects; ++i) {
    const Pose& X = objects[i].X_WO;
    const double is[7] = {X.p.x(), X.p.y(), X.p.z(), X.q.w(), X.q.x(), X.q.y(), X.q.z()};
    std::copy(is, is + 7, truth.mutable_data(i, 0));
    const TrackedObject& o = session.poses().objects[i];
    std::copy(o.covariance.begin(), o.covariance.end(), covariance.mutable_data(i, 0));
    age.mutable_at(i) = o.age;
    const double row[7] = {o.X_WO.p.x(), o.X_WO.p.y(), o.X_WO.p.z(), o.X_WO.q.w(),
                           o.X_WO.q.x(), o.X_WO.q.y(), o.X_WO.q.z()};
    std::copy(row, row + 7, pose.mutable_data(i, 0));
    valid.mutable_at(i) = o.id >= 0 && o.valid;
  }
  const ArmStatus& s = session.status();
  py::dict d;
  d["utime"] = s.utime;
  d["q"] = s.q;
  d["dq"] = s.dq;
  d["q_commanded"] = s.q_commanded;
  d["gripper_closed"] = s.gripper_closed;
  d["state"] = static_cast<int>(s.state);
  d["object_pose"] = pose;
  d["object_valid"] = valid;
  d["object_age"] = age;
  d["object_covariance"] = covariance;
  d["object_truth"] = truth;
  return d;
}

NetworkOptions FormatOptions(const std::string& format) {
  NetworkOptions options;
  if (!format.empty()) options.format = ParseWeightFormat(format);
  return options;
}

constexpr int kFilmWidth = 320, kFilmHeight = 240;
constexpr double kNudge = 0.04;       // [m]
constexpr double kNudgeWithin = 0.12;  // [m] of the tip

template <typename T>
using Array = py::array_t<T, py::array::c_style | py::array::forcecast>;

// Session + skill controller: one closed-loop run.
class Rollout {
 public:
  Rollout(const std::string& models_dir, const std::string& task, const std::string& weights_dir,
          const std::string& perception_config, const std::string& format)
      : session_(models_dir, task,
                 perception_config.empty() ? std::nullopt
                                           : std::optional<PerceptionConfig>(LoadPerceptionConfig(perception_config))),
        player_(SkillPlayer::Load(weights_dir, ArmModel::Lite6(), FormatOptions(format))) {}

  py::dict Reset(int64_t seed, double spread_cm) {
    {
      py::gil_scoped_release release;
      session_.Reset(seed, spread_cm);
    }
    reset_ = true;
    return Observe(session_);
  }

  py::dict Run(const Array<float>& z, const Array<int>& ticks, const std::vector<int>& library_index, int settle_ticks,
               const std::string& ablate, bool nudge, int film_every, bool others) {
    if (!reset_) throw std::runtime_error("reset() comes before run(): each run begins in a scene of its own");
    const auto count = static_cast<py::ssize_t>(library_index.size());
    if (z.ndim() != 2 || z.shape(1) != kLatentDim || z.shape(0) != count || ticks.ndim() != 2 || ticks.shape(0) != count ||
        ticks.shape(1) != 2)
      throw py::value_error("z must be (n, 16), ticks (n, 2), library_index n numbers");
    const std::vector<Skill>& library = player_.library()->skills;
    std::vector<Skill> skills(library_index.size());
    for (size_t i = 0; i < skills.size(); ++i) {
      const auto row = static_cast<py::ssize_t>(i);
      const auto at = static_cast<size_t>(library_index[i]);
      if (library_index[i] >= 0 && at >= library.size()) throw py::value_error("library_index out of range");
      if (library_index[i] >= 0) skills[i] = library[at];
      skills[i].z = Eigen::Map<const LatentVector>(z.data(row, 0));
      skills[i].min_ticks = *ticks.data(row, 0);
      skills[i].max_ticks = *ticks.data(row, 1);
    }
    SkillController controller(player_, 1);
    controller.player().ZeroActions(ablate == "policy");
    controller.player().TryOthers(others);
    bool success = false;
    std::vector<double> q, poses_trace, gripper;
    std::vector<int> skill_trace;
    std::vector<Snapshot> film;
    uint64_t hash = 0;
    uint32_t subgoals = 0;
    double seconds = 0;
    std::string reason;
    {
      py::gil_scoped_release release;
      if (controller.Start(1, skills) != Status::kOk) throw std::runtime_error("the plan is empty, too long or not finite");
      ObjectPoses first = session_.poses();
      ArmCommand command;
      for (int left = settle_ticks; left > 0;) {
        ObjectPoses poses = session_.poses();
        if (ablate == "objects") {
          // Frozen at the first value each object had.
          for (int i = 0; i < kMaxObjects; ++i) {
            if (first.objects[i].id < 0 || !first.objects[i].valid) first.objects[i] = poses.objects[i];
            poses.objects[i] = first.objects[i];
          }
        }
        const bool was_closed = session_.status().gripper_closed;
        (void)controller.Tick(session_.status(), poses, command);
        if (nudge && command.gripper_closed && !was_closed) nudge = !Nudge();
        (void)session_.Advance(command);
        for (int i = 0; i < kNumJoints; ++i) q.push_back(session_.status().q[i]);
        gripper.push_back(session_.status().gripper_closed ? 1 : 0);
        skill_trace.push_back(controller.player().status().skill_index);
        for (const TrackedObject& o : session_.world().Objects()) {
          poses_trace.insert(poses_trace.end(), {o.X_WO.p.x(), o.X_WO.p.y(), o.X_WO.p.z(), o.X_WO.q.w(), o.X_WO.q.x(),
                                                 o.X_WO.q.y(), o.X_WO.q.z()});
        }
        if (film_every > 0 && skill_trace.size() % static_cast<size_t>(film_every) == 0) {
          session_.world().Save(film.emplace_back());
        }
        subgoals |= session_.world().Subgoals();
        if (!controller.player().playing()) --left;
      }
      success = session_.world().Success();
      if (!success) reason = session_.world().FailureReason();
      hash = session_.world().StateHash();
      seconds = 1e-6 * static_cast<double>(session_.status().utime);
    }
    const PlayerStatus& status = controller.player().status();
    py::dict d;
    d["success"] = success;
    d["reason"] = reason;
    d["subgoals"] = subgoals;
    d["state_hash"] = hash;
    d["duration_s"] = seconds;
    d["end_reason"] = static_cast<int>(status.end_reason);
    d["skill"] = status.skill_index;
    d["retries"] = status.retries;
    const auto n = static_cast<py::ssize_t>(gripper.size());
    d["q"] = py::array_t<double>({n, py::ssize_t{kNumJoints}}, q.data());
    d["gripper"] = py::array_t<double>(n, gripper.data());
    d["skills"] = py::array_t<int>(n, skill_trace.data());
    d["object_pose"] = py::array_t<double>({n, py::ssize_t{kMaxObjects}, py::ssize_t{7}}, poses_trace.data());
    py::list pictures;
    for (const Snapshot& snapshot : film) pictures.append(Picture(snapshot));
    d["pictures"] = pictures;
    return d;
  }

 private:
  py::array_t<uint8_t> Picture(const Snapshot& snapshot) {
    if (!renderer_) renderer_ = std::make_unique<Renderer>(session_.world(), kFilmWidth, kFilmHeight);
    py::array_t<uint8_t> rgb({kFilmHeight, kFilmWidth, 3});
    renderer_->Render(snapshot, renderer_->FindCamera("overview"), rgb.mutable_data());
    return rgb;
  }

  // Knocks the object at the tip out of the closing fingers, along the axis in which they leave it room. Whether there was one.
  bool Nudge() {
    const Pose X_WG = ArmModel::Lite6().Tip(session_.status().q);
    const auto objects = session_.world().Objects();
    int nearest = -1;
    double distance = kNudgeWithin;
    for (int i = 0; i < kMaxObjects; ++i) {
      if (objects[i].id < 0) continue;
      if (const double d = (objects[i].X_WO.p - X_WG.p).norm(); d < distance) {
        distance = d;
        nearest = i;
      }
    }
    if (nearest < 0) return false;
    Eigen::Vector3d along = X_WG.q * Eigen::Vector3d::UnitX();
    along.z() = 0;
    if (along.norm() < 0.3) along = Eigen::Vector3d::UnitX();
    session_.Nudge(nearest, kNudge * along.normalized());
    return true;
  }

  Session session_;
  bool reset_ = false;  // there is a scene
  SkillPlayer player_;
  std::unique_ptr<Renderer> renderer_;
};

// Many plans at once, in the head.
class Imagination {
 public:
  Imagination(const std::string& weights_dir, int n, const std::string& format)
      : rollout_(WeightsFile::Load(weights_dir), ArmModel::Lite6(), n, FormatOptions(format)) {}

  py::dict Run(const JointVector& q, bool gripper_closed, const Array<double>& object_pose, const Array<bool>& object_known,
               const std::vector<Array<float>>& z, const std::vector<std::vector<int>>& ticks) {
    if (object_pose.ndim() != 2 || object_pose.shape(0) != kMaxObjects || object_pose.shape(1) != 7 ||
        object_known.ndim() != 1 || object_known.shape(0) != kMaxObjects || z.size() != ticks.size())
      throw py::value_error("object_pose must be (4, 7), object_known (4,), z and ticks one entry a plan");
    Observation start;
    start.q = q;
    start.gripper_closed = gripper_closed;
    for (int i = 0; i < kMaxObjects; ++i) {
      if (!*object_known.data(i)) continue;
      const double* v = object_pose.data(i, 0);
      start.objects[i].id = i;
      start.objects[i].valid = true;
      start.objects[i].X_WO = {{v[0], v[1], v[2]}, Eigen::Quaterniond(v[3], v[4], v[5], v[6])};
    }
    std::vector<std::vector<Skill>> plans(z.size());
    int longest = 0;
    for (size_t i = 0; i < z.size(); ++i) {
      const auto skills = static_cast<py::ssize_t>(ticks[i].size());
      if (z[i].ndim() != 2 || z[i].shape(0) != skills || z[i].shape(1) != kLatentDim)
        throw py::value_error("z of each plan must be (skills, 16), ticks skills numbers");
      int length = 0;
      for (py::ssize_t k = 0; k < skills; ++k) {
        Skill s;
        s.z = Eigen::Map<const LatentVector>(z[i].data(k, 0));
        s.min_ticks = s.max_ticks = ticks[i][static_cast<size_t>(k)];
        if (s.max_ticks < 1) throw py::value_error("a skill lasts 1 tick or more");
        plans[i].push_back(s);
        length += s.max_ticks;
      }
      longest = std::max(longest, length);
    }
    const auto n = static_cast<py::ssize_t>(plans.size());
    py::array_t<double> joints({n, py::ssize_t{longest}, py::ssize_t{kNumJoints}});
    py::array_t<bool> gripper({n, py::ssize_t{longest}});
    py::array_t<double> poses({n, py::ssize_t{longest}, py::ssize_t{kMaxObjects}, py::ssize_t{7}});
    Status status;
    {
      py::gil_scoped_release release;
      status = rollout_.Run(start, plans, [&](int t) {
        for (py::ssize_t i = 0; i < n; ++i) {
          const Observation& o = rollout_.states()[static_cast<size_t>(i)];
          for (int k = 0; k < kNumJoints; ++k) *joints.mutable_data(i, t, k) = o.q[k];
          *gripper.mutable_data(i, t) = o.gripper_closed;
          for (int k = 0; k < kMaxObjects; ++k) {
            const Pose& X = o.objects[k].X_WO;
            const double is[7] = {X.p.x(), X.p.y(), X.p.z(), X.q.w(), X.q.x(), X.q.y(), X.q.z()};
            std::copy(is, is + 7, poses.mutable_data(i, t, k, 0));
          }
        }
      });
    }
    if (status != Status::kOk) throw py::value_error("no plan, more plans than there is room for, or a value that is not finite");
    py::dict d;
    d["q"] = joints;
    d["gripper"] = gripper;
    d["object_pose"] = poses;
    return d;
  }

 private:
  KinematicRollout rollout_;
};

}  // namespace

void Bind_sim(py::module_& m) {
  py::class_<Session>(m, "Session", "In-process plant and perception in lockstep, one policy tick (40 ms) at a time.")
      .def(py::init([](const std::string& models_dir, const std::string& task, const std::string& perception_config) {
             return std::make_unique<Session>(
                 models_dir, task,
                 perception_config.empty() ? std::nullopt
                                           : std::optional<PerceptionConfig>(LoadPerceptionConfig(perception_config)));
           }),
           py::arg("models_dir"), py::arg("task"), py::arg("perception_config") = "",
           "perception_config: YAML of intabs_perception; empty: poses are the plant's truth.")
      .def("reset", &Session::Reset, py::arg("seed"), py::arg("spread_cm"), py::call_guard<py::gil_scoped_release>())
      .def("observe", &Observe,
           "utime [us], q, dq, q_commanded (6,), gripper_closed, state, object_pose (4, 7) xyz wxyz, object_valid (4,),\n"
           "object_age (4,) [s], object_covariance (4, 21) (core/types.h), object_truth (4, 7)")
      .def(
          "command",
          [](Session& s, const JointVector& q_target, bool gripper_closed) {
            ArmCommand c;
            c.utime = s.status().utime;
            c.seq = s.status().last_command_seq + 1;
            c.session = 1;
            c.status_seq = s.status().seq;
            c.mode = ArmMode::kServo;
            c.q_target = q_target;
            c.gripper_closed = gripper_closed;
            py::gil_scoped_release release;
            return static_cast<int>(s.Advance(c));
          },
          py::arg("q_target"), py::arg("gripper_closed"), "Answers this tick, goes on to the next. 0, or why it was refused.")
      .def_property_readonly("success", [](const Session& s) { return s.world().Success(); })
      .def_property_readonly("failure_reason", [](const Session& s) { return s.world().FailureReason(); })
      .def_property_readonly("state_hash", [](const Session& s) { return s.world().StateHash(); });

  py::class_<Rollout>(m, "Rollout", "Closed-loop runs of a plan in the plant, in process, in lockstep.")
      .def(py::init<const std::string&, const std::string&, const std::string&, const std::string&, const std::string&>(),
           py::arg("models_dir"), py::arg("task"), py::arg("weights_dir"), py::arg("perception_config") = "",
           py::arg("format") = "", "format of pi's weights: fp32, 16, 8; empty: the manifest's.")
      .def("reset", &Rollout::Reset, py::arg("seed"), py::arg("spread_cm"), "Starts over; what is seen then (Session.observe).")
      .def("run", &Rollout::Run, py::arg("z"), py::arg("ticks"), py::arg("library_index"), py::arg("settle_ticks") = 25,
           py::arg("ablate") = "", py::arg("nudge") = false, py::arg("film_every") = 0, py::arg("others") = true,
           "From where reset left it. z (n, 16); ticks (n, 2): shortest and longest duration; library_index: n numbers, -1: a\n"
           "skill without a record. ablate: '', 'objects' (poses frozen at their first value) or 'policy' (zeros). nudge: the\n"
           "first time the fingers close about an object it is knocked away by 4 cm. film_every: a picture each so many ticks. others:\n"
           "what fails twice is tried as another demonstration did it (skills/skill_player.h).\n"
           "Returns success, reason, subgoals (bits), state_hash, duration_s, end_reason, skill (the last that ran), retries and,\n"
           "after each tick, q (T, 6), gripper (T,), skills (T,) and the true object_pose (T, 4, 7), and\n"
           "pictures [(240, 320, 3) uint8 RGB].");

  py::class_<Imagination>(m, "KinematicRollout", "Plans played in the head: pi closed on its own predictions, many at once.")
      .def(py::init<const std::string&, int, const std::string&>(), py::arg("weights_dir"), py::arg("n"), py::arg("format") = "",
           "n: plans at a time, at most.")
      .def("run", &Imagination::Run, py::arg("q"), py::arg("gripper_closed"), py::arg("object_pose"), py::arg("object_known"),
           py::arg("z"), py::arg("ticks"),
           "From joints q (6,), object_pose (4, 7), object_known (4,). z: for each plan (skills, 16); ticks: for each plan how\n"
           "long its skills last. Returns after each tick q (n, T, 6), gripper (n, T), object_pose (n, T, 4, 7); a plan that is\n"
           "over keeps its last state. ValueError if something does not fit or is not finite.");
}

}  // namespace intabs
