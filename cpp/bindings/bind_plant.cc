#include <pybind11/eigen.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "intabs/plant/renderer.h"
#include "intabs/plant/task.h"
#include "intabs/plant/world.h"

namespace py = pybind11;

namespace intabs {

void Bind_plant(py::module_& m) {
  py::class_<World>(m, "World", "MuJoCo world of one task; deterministic. One thread at a time.")
      .def(py::init<const std::string&, const std::string&>(), py::arg("models_dir"), py::arg("task"),
           "Loads models_dir/scenes/<task>.xml. RuntimeError on an unknown task or a broken scene.")
      .def("reset", &World::Reset, py::arg("seed"), py::arg("spread_cm"), py::call_guard<py::gil_scoped_release>(),
           "Time zero, arm at home, objects placed by the seed.")
      .def(
          "step",
          [](World& w, const JointVector& q, const JointVector& dq, bool gripper_closed, int ticks) {
            py::gil_scoped_release release;
            for (int i = 0; i < ticks; ++i) w.Step({q, dq, gripper_closed});
          },
          py::arg("q"), py::arg("dq"), py::arg("gripper_closed"), py::arg("ticks") = 1,
          "Driver ticks of 4 ms towards q (6,) rad with feed-forward dq (6,) rad/s.")
      .def_property_readonly("time_us", &World::time_us)
      .def(
          "arm",
          [](const World& w) {
            const ArmMeasurement a = w.Arm();
            py::dict d;
            d["q"] = a.q;
            d["dq"] = a.dq;
            d["tau"] = a.tau;
            d["gripper_opening"] = a.gripper_opening;
            return d;
          },
          "q [rad], dq [rad/s], tau [Nm], each (6,); gripper_opening [m].")
      .def(
          "objects",
          [](const World& w) {
            py::dict d;
            for (const TrackedObject& o : w.Objects()) {
              if (o.id < 0) continue;
              Eigen::Matrix<double, 7, 1> pose;
              pose << o.X_WO.p, o.X_WO.q.w(), o.X_WO.q.x(), o.X_WO.q.y(), o.X_WO.q.z();
              d[py::int_(o.id)] = pose;
            }
            return d;
          },
          "{id: p_WO [m] and q_WO wxyz (7,)}: the truth.")
      .def(
          "contacts",
          [](const World& w) {
            const Contacts c = w.Touches();
            py::dict d;
            for (int slot = 0; slot < kMaxObjects; ++slot) {
              const TrackedObject o = w.Objects()[slot];
              if (o.id < 0) continue;
              const uint8_t bits = c.touches[slot];
              py::list touched;
              for (int other = 0; other < kMaxObjects; ++other) {
                if (bits >> other & 1) touched.append(w.Objects()[other].id);
              }
              py::dict one;
              one["fingers"] = py::make_tuple((bits & kTouchesLeftFinger) != 0, (bits & kTouchesRightFinger) != 0);
              one["arm"] = (bits & kTouchesArm) != 0;
              one["scene"] = (bits & kTouchesScene) != 0;
              one["objects"] = touched;
              one["beads"] = c.beads_in[slot];
              d[py::int_(o.id)] = one;
            }
            return d;
          },
          "{id: {fingers: (left, right), arm: another part of it, scene: table or furniture, objects: [ids],\n"
          "beads: inside this vessel}}: whom each object touches.")
      .def_property_readonly("success", &World::Success)
      .def_property_readonly("subgoals", &World::Subgoals)
      .def_property_readonly("subgoal_names", &World::SubgoalNames)
      .def_property_readonly("failure_reason", &World::FailureReason)
      .def_property_readonly("state_hash", &World::StateHash);

  m.def("task_names", [] { return TaskNames(); }, "What World knows: tasks, then compositions.");

  py::class_<Renderer>(m, "Renderer", "Pictures of a World without a window.")
      .def(py::init<const World&, int, int>(), py::arg("world"), py::arg("width") = 640, py::arg("height") = 480)
      .def(
          "render",
          [](Renderer& r, const World& world, const std::string& camera) {
            Snapshot s;
            world.Save(s);
            py::array_t<uint8_t> rgb({r.height(), r.width(), 3});
            uint8_t* out = rgb.mutable_data();
            const int id = r.FindCamera(camera);
            {
              py::gil_scoped_release release;
              r.Render(s, id, out);
            }
            return rgb;
          },
          py::arg("world"), py::arg("camera"), "(H, W, 3) uint8 RGB. RuntimeError on an unknown camera.");
}

}  // namespace intabs
