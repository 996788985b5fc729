#include <pybind11/eigen.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include "intabs/skills/policy.h"
#include "intabs/skills/state.h"

namespace py = pybind11;

namespace intabs {
namespace {

template <typename T>
using Array = py::array_t<T, py::array::c_style | py::array::forcecast>;

void DemandShape(const char* name, const py::array& a, std::initializer_list<py::ssize_t> shape) {
  bool ok = a.ndim() == static_cast<py::ssize_t>(shape.size());
  if (ok) {
    int i = 0;
    for (const py::ssize_t n : shape) ok = ok && a.shape(i++) == n;
  }
  if (ok) return;
  std::string want, got;
  for (const py::ssize_t n : shape) want += std::to_string(n) + ",";
  for (int i = 0; i < a.ndim(); ++i) got += std::to_string(a.shape(i)) + ",";
  throw py::value_error(std::string(name) + " has shape (" + got + "), wanted (" + want + ")");
}

Pose ReadPose(const double* v) { return {{v[0], v[1], v[2]}, Eigen::Quaterniond(v[3], v[4], v[5], v[6])}; }

py::array_t<float> AssembleStates(const ArmModel& arm, const Array<double>& q, const Array<bool>& gripper_closed,
                                  const Array<double>& object_pose, const Array<bool>& object_known,
                                  const Array<bool>& object_valid) {
  const py::ssize_t n = q.ndim() == 2 ? q.shape(0) : 0;
  DemandShape("q", q, {n, kNumJoints});
  DemandShape("gripper_closed", gripper_closed, {n});
  DemandShape("object_pose", object_pose, {n, kMaxObjects, 7});
  DemandShape("object_known", object_known, {n, kMaxObjects});
  DemandShape("object_valid", object_valid, {n, kMaxObjects});
  py::array_t<float> out({n, py::ssize_t{kStateDim}});
  py::ssize_t bad = -1;
  {
    py::gil_scoped_release release;
    for (py::ssize_t t = 0; t < n && bad < 0; ++t) {
      Observation o;
      o.q = Eigen::Map<const JointVector>(q.data(t, 0));
      o.gripper_closed = *gripper_closed.data(t);
      for (int i = 0; i < kMaxObjects; ++i) {
        if (!*object_known.data(t, i)) continue;
        o.objects[i].id = i;
        o.objects[i].X_WO = ReadPose(object_pose.data(t, i, 0));
        o.objects[i].valid = *object_valid.data(t, i);
      }
      StateVector s;
      if (AssembleState(arm, o, s) != Status::kOk) bad = t;
      std::copy(s.data(), s.data() + kStateDim, out.mutable_data(t, 0));
    }
  }
  if (bad >= 0) throw py::value_error("tick " + std::to_string(bad) + " holds a value that is not finite");
  return out;
}

py::array_t<float> ObjectMotions(const ArmModel& arm, const Array<double>& q, const Array<double>& object_pose,
                                 const Array<bool>& object_known) {
  const py::ssize_t n = q.ndim() == 2 ? q.shape(0) : 0;
  DemandShape("q", q, {n, kNumJoints});
  DemandShape("object_pose", object_pose, {n, kMaxObjects, 7});
  DemandShape("object_known", object_known, {n, kMaxObjects});
  py::array_t<float> out({std::max<py::ssize_t>(n - 1, 0), py::ssize_t{kEnvironmentActionDim}});
  std::fill(out.mutable_data(), out.mutable_data() + out.size(), 0.f);
  py::gil_scoped_release release;
  for (py::ssize_t t = 0; t + 1 < n; ++t) {
    const Pose X_WG = arm.Tip(Eigen::Map<const JointVector>(q.data(t, 0)));
    for (int i = 0; i < kMaxObjects; ++i) {
      if (!*object_known.data(t, i) || !*object_known.data(t + 1, i)) continue;
      const auto m = ObjectMotion(X_WG, ReadPose(object_pose.data(t, i, 0)), ReadPose(object_pose.data(t + 1, i, 0)));
      std::copy(m.data(), m.data() + kObjectMotionDim, out.mutable_data(t, i * kObjectMotionDim));
    }
  }
  return out;
}

py::array_t<float> Normalize(const Array<float>& states, const StateVector& mean, const StateVector& scale, float limit) {
  const py::ssize_t n = states.ndim() == 2 ? states.shape(0) : 0;
  DemandShape("states", states, {n, kStateDim});
  Normalizer normalizer{mean, scale.cwiseInverse(), limit};
  py::array_t<float> out({n, py::ssize_t{kStateDim}});
  for (py::ssize_t t = 0; t < n; ++t) {
    StateVector s = Eigen::Map<const StateVector>(states.data(t, 0));
    normalizer.Apply(s);
    std::copy(s.data(), s.data() + kStateDim, out.mutable_data(t, 0));
  }
  return out;
}

}  // namespace

void Bind_skills(py::module_& m) {
  m.attr("STATE_LAYOUT") = kStateLayout;
  m.attr("STATE_DIM") = kStateDim;
  m.def("assemble_states", &AssembleStates, py::arg("arm"), py::arg("q"), py::arg("gripper_closed"),
        py::arg("object_pose"), py::arg("object_known"), py::arg("object_valid"),
        "State features s = [s^r, s^e] of each tick, not normalised, (T, 59) float32.\n\n"
        "q (T, 6) rad; gripper_closed (T,); object_pose (T, 4, 7) p_WO [m] and q_WO wxyz; object_known (T, 4): seen at\n"
        "least once so far; object_valid (T, 4). The code that runs in the control loop. ValueError on a value that is\n"
        "not finite or a wrong shape.");
  m.def("object_motions", &ObjectMotions, py::arg("arm"), py::arg("q"), py::arg("object_pose"), py::arg("object_known"),
        "Motion a^e of each object from tick to tick, (T - 1, 24) float32: per slot [m, rad] in the gripper's axes.");
  m.def("normalize", &Normalize, py::arg("states"), py::arg("mean"), py::arg("scale"), py::arg("limit"),
        "(states - mean) / scale clamped to +-limit, (T, 59) float32: what the policy's input gets at run time.");
}

}  // namespace intabs
