// ArmModel and IkSolver for Python. A pose is an array (7,): x y z [m], then the quaternion w x y z.
#include <pybind11/eigen.h>
#include <pybind11/pybind11.h>

#include "intabs/kinematics/ik.h"
#include "intabs/kinematics/urdf.h"

namespace intabs {
namespace {

namespace py = pybind11;
using namespace pybind11::literals;
using PoseArray = Eigen::Matrix<double, 7, 1>;

PoseArray ToArray(const Pose& X) {
  PoseArray a;
  a << X.p, X.q.w(), X.q.vec();
  return a;
}

template <int kColumns>
using Path = Eigen::Matrix<double, Eigen::Dynamic, kColumns, Eigen::RowMajor>;

Pose ToPose(const PoseArray& a) { return {a.head<3>(), Eigen::Quaterniond(a[3], a[4], a[5], a[6])}; }

}  // namespace

void Bind_kinematics(py::module_& m) {
  py::class_<ArmModel>(
      m, "ArmModel",
      "Kinematics of the arm. Joint angles q (6,) in rad; poses (7,): xyz [m], quaternion wxyz.")
      .def_static("lite6", &ArmModel::Lite6, "The nominal Lite 6 with its gripper.")
      .def_static("load", &LoadArmModel, "urdf_path"_a, "base"_a = "link_base", "tip"_a = "tip",
                  "The arm of a URDF file. Raises RuntimeError with one line if it is not one.")
      .def(
          "fk", [](const ArmModel& arm, const JointVector& q) { return ToArray(arm.Fk(q)); }, "q"_a,
          "Pose (7,) of the flange in the base.")
      .def(
          "tip", [](const ArmModel& arm, const JointVector& q) { return ToArray(arm.Tip(q)); }, "q"_a,
          "Pose (7,) of the gripper's tip in the base.")
      .def(
          "places",
          [](const ArmModel& arm, const JointVector& q) {
            Eigen::Matrix<double, kNumJoints + 2, 3, Eigen::RowMajor> line;
            const ArmModel::Line places = arm.Places(q);
            for (int i = 0; i < kNumJoints + 2; ++i) line.row(i) = places[i];
            return line;
          },
          "q"_a, "(8, 3): the base, the joints and the gripper's tip in the base.")
      .def(
          "distance_from",
          [](const ArmModel& arm, const Path<kNumJoints>& q, const Path<3>& p) {
            if (q.rows() != p.rows()) throw py::value_error("q and p must have as many rows");
            Eigen::VectorXd out(q.rows());
            for (Eigen::Index t = 0; t < q.rows(); ++t) out[t] = arm.DistanceFrom(q.row(t), p.row(t));
            return out;
          },
          "q"_a, "p"_a, "(T,) [m]: of points p (T, 3) in the base from the arm's line from elbow to tip at q (T, 6).")
      .def("jacobian", &ArmModel::Jacobian, "q"_a,
           "(6, 6): linear [m/s], then angular [rad/s] velocity of the tip in the base, by joint velocity.")
      .def_property_readonly(
          "frames",
          [](const ArmModel& arm) {
            Eigen::Matrix<double, kNumJoints + 1, 7, Eigen::RowMajor> frames;
            for (int i = 0; i < kNumJoints; ++i) frames.row(i) = ToArray(arm.parameters().X_PJ[i]);
            frames.row(kNumJoints) = ToArray(arm.parameters().X_EG);
            return frames;
          },
          "(7, 7): the frame of each joint, at q = 0, in the link before it; last the tip in the flange.")
      .def_property_readonly(
          "q_min", [](const ArmModel& arm) { return arm.q_min(); }, "Lower joint limits (6,) in rad.")
      .def_property_readonly(
          "q_max", [](const ArmModel& arm) { return arm.q_max(); }, "Upper joint limits (6,) in rad.");

  py::enum_<IkChoice>(m, "IkChoice")
      .value("NEAREST", IkChoice::kNearest, "least |q - q_seed|")
      .value("BEST_SCORE", IkChoice::kBestScore, "highest score; of equal ones the nearest to q_seed");

  py::class_<IkResult>(m, "IkResult")
      .def_readonly("ok", &IkResult::ok, "Whether q is an answer.")
      .def_readonly("q", &IkResult::q, "(6,) rad, within the joint limits; zeros if not ok.")
      .def_readonly("score", &IkResult::score, "arm_score of q.")
      .def_readonly("why", &IkResult::why, "Why there is no answer, one line.")
      .def("__bool__", [](const IkResult& r) { return r.ok; });

  py::class_<IkSolver>(m, "IkSolver",
                       "Inverse kinematics for the gripper's tip, all branches, within the joint limits.")
      .def(py::init<const ArmModel&>(), "model"_a)
      .def(
          "solve",
          [](const IkSolver& ik, const PoseArray& X_BG, const JointVector& q_seed, IkChoice choice) {
            return ik.Solve(ToPose(X_BG), q_seed, choice);
          },
          "pose"_a, "q_seed"_a, "choice"_a = IkChoice::kNearest,
          "IkResult for the tip's pose (7,) in the base. Along a path give the last answer as q_seed. An "
          "answer is "
          "within 1e-5 m and 1e-4 rad; what cannot be reached is refused.");

  m.def("arm_score", &ArmScore, "model"_a, "q"_a,
        "min(distance to the nearest joint limit [rad], 5 x smallest singular value of the Jacobian): how "
        "far q (6,) "
        "is from getting stuck.");
}

}  // namespace intabs
