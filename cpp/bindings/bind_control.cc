// What the command filter keeps the arm clear of, for Python: planners ask before they command.
#include <pybind11/eigen.h>
#include <pybind11/pybind11.h>

#include "intabs/control/command_filter.h"

namespace intabs {

namespace py = pybind11;

void Bind_control(py::module_& m) {
  m.def(
      "arm_clearance",
      [](const JointVector& q) {
        CommandFilter filter(ArmLimits{}, ArmModel::Lite6());
        filter.Reset(q);
        const StopGuard::Clearance c = filter.guard().clearance();
        const ArmSpace space;
        return py::make_tuple(c.self - space.self_margin, c.table - space.table_margin, c.box);
      },
      py::arg("q"),
      "At q (6,) in rad: by how many m the arm could come nearer to itself, to the table, to its workspace's\n"
      "faces, before the command filter stops it.");
}

}  // namespace intabs
