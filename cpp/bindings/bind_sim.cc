#include <pybind11/eigen.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "intabs/sim/session.h"
#include "intabs/skills/skill_controller.h"

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

// Session + skill controller: one closed-loop run.
class Rollout {
 public:
  Rollout(const std::string& models_dir, const std::string& task, const std::string& weights_dir,
          const std::string& perception_config, const std::string& format)
      : session_(models_dir, task,
                 perception_config.empty() ? std::nullopt
                                           : std::optional<PerceptionConfig>(LoadPerceptionConfig(perception_config))),
        policy_(Policy::Load(weights_dir, ArmModel::Lite6(), FormatOptions(format))) {}

  py::dict Run(int64_t seed, double spread_cm, const py::array_t<float, py::array::c_style | py::array::forcecast>& z,
               const std::vector<int>& ticks, int settle_ticks, const std::string& ablate) {
    if (z.ndim() != 2 || z.shape(1) != kLatentDim || z.shape(0) != static_cast<py::ssize_t>(ticks.size()))
      throw py::value_error("z must be (n, 16) with one number of ticks a row");
    std::vector<Skill> skills(ticks.size());
    for (size_t i = 0; i < skills.size(); ++i) {
      skills[i].z = Eigen::Map<const LatentVector>(z.data(i, 0));
      skills[i].min_ticks = skills[i].max_ticks = ticks[i];
    }
    SkillController controller(policy_, 1);
    controller.player().ZeroActions(ablate == "policy");
    bool success = false;
    std::vector<double> q, poses_trace, gripper;
    uint64_t hash = 0;
    uint32_t subgoals = 0;
    double seconds = 0;
    std::string reason;
    {
      py::gil_scoped_release release;
      session_.Reset(seed, spread_cm);
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
        (void)controller.Tick(session_.status(), poses, command);
        (void)session_.Advance(command);
        for (int i = 0; i < kNumJoints; ++i) q.push_back(session_.status().q[i]);
        gripper.push_back(session_.status().gripper_closed ? 1 : 0);
        for (const TrackedObject& o : session_.world().Objects()) {
          poses_trace.insert(poses_trace.end(), {o.X_WO.p.x(), o.X_WO.p.y(), o.X_WO.p.z(), o.X_WO.q.w(), o.X_WO.q.x(),
                                                 o.X_WO.q.y(), o.X_WO.q.z()});
        }
        subgoals |= session_.world().Subgoals();
        if (!controller.player().playing()) --left;
      }
      success = session_.world().Success();
      if (!success) reason = session_.world().FailureReason();
      hash = session_.world().StateHash();
      seconds = 1e-6 * static_cast<double>(session_.status().utime);
    }
    py::dict d;
    d["success"] = success;
    d["reason"] = reason;
    d["subgoals"] = subgoals;
    d["state_hash"] = hash;
    d["duration_s"] = seconds;
    d["end_reason"] = static_cast<int>(controller.player().status().end_reason);
    const auto n = static_cast<py::ssize_t>(gripper.size());
    d["q"] = py::array_t<double>({n, py::ssize_t{kNumJoints}}, q.data());
    d["gripper"] = py::array_t<double>(n, gripper.data());
    d["object_pose"] = py::array_t<double>({n, py::ssize_t{kMaxObjects}, py::ssize_t{7}}, poses_trace.data());
    return d;
  }

 private:
  Session session_;
  Policy policy_;
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
      .def("run", &Rollout::Run, py::arg("seed"), py::arg("spread_cm"), py::arg("z"), py::arg("ticks"),
           py::arg("settle_ticks") = 25, py::arg("ablate") = "",
           "z (n, 16), ticks: n durations. ablate: '', 'objects' (poses frozen at their first value) or 'policy' (zeros).\n"
           "Returns success, reason, subgoals (bits), state_hash, duration_s, end_reason and, after each tick, q (T, 6),\n"
           "gripper (T,) and the true object_pose (T, 4, 7).");
}

}  // namespace intabs
