// Gaps in tracks and key points of hands, for Python. A pose is an array (7,): x y z [m], then the quaternion
// w x y z.
#include <pybind11/eigen.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <opencv2/core.hpp>

#include "intabs/perception/gaps.h"
#include "intabs/perception/hand.h"

namespace py = pybind11;
using namespace pybind11::literals;

namespace intabs {
namespace {

using Doubles = py::array_t<double, py::array::c_style | py::array::forcecast>;
using Bools = py::array_t<bool, py::array::c_style | py::array::forcecast>;
using Bytes = py::array_t<uint8_t, py::array::c_style | py::array::forcecast>;

// Throws ValueError "NAME must be (21, 2)" when it is not. -1 in `shape`: any.
void CheckShape(const py::array& a, const char* name, const std::vector<py::ssize_t>& shape) {
  bool ok = a.ndim() == static_cast<py::ssize_t>(shape.size());
  std::string text;
  for (size_t i = 0; i < shape.size(); ++i) {
    ok = ok && (shape[i] < 0 || a.shape(i) == shape[i]);
    text += (i ? ", " : "") + (shape[i] < 0 ? std::string("T") : std::to_string(shape[i]));
  }
  if (!ok) throw py::value_error(std::string(name) + " must be (" + text + ")");
}

Pose ToPose(const double* v) { return {Eigen::Vector3d(v[0], v[1], v[2]), {v[3], v[4], v[5], v[6]}}; }

Pose OneMore(const double* v, const char* name) {  // a pose that must be one
  const Pose X = ToPose(v);
  if (!X.IsFinite() || std::abs(X.q.norm() - 1) > 1e-3) {
    throw py::value_error(std::string(name) + " is not finite, or its quaternion not of unit norm");
  }
  return X;
}

void FromPose(const Pose& X, double* v) {
  std::copy_n(X.p.data(), 3, v);
  v[3] = X.q.w();
  std::copy_n(X.q.vec().data(), 3, v + 4);
}

GapOptions Options(const std::string& method, double max_gap, double slerp_gap, double sigma) {
  GapOptions o;
  if (method == "linear") {
    o.method = GapMethod::kLinear;
  } else if (method != "kalman") {
    throw py::value_error("method \"" + method + "\" is not known: kalman, linear");
  }
  o.max_gap = max_gap;
  o.slerp_gap = slerp_gap;
  o.sigma = sigma;
  return o;
}

py::tuple Fill(const Doubles& time, const Doubles& value, const Bools& valid, const std::string& method,
               double max_gap, double slerp_gap, double sigma) {
  CheckShape(time, "time", {-1});
  const py::ssize_t n = time.shape(0);
  const bool poses = value.ndim() == 2 && value.shape(1) == 7;
  CheckShape(value, "value", {n, poses ? 7 : 3});
  CheckShape(valid, "valid", {n});
  const GapOptions options = Options(method, max_gap, slerp_gap, sigma);
  std::vector<SampleState> state(n);
  for (py::ssize_t k = 0; k < n; ++k) {
    state[k] = valid.at(k) ? SampleState::kMeasured : SampleState::kInvalid;
  }
  py::array_t<double> out({n, value.shape(1)}), sd(n);
  std::copy_n(value.data(), value.size(), out.mutable_data());
  const std::span<const double> time_span(time.data(), n);
  const std::span<double> sd_span(sd.mutable_data(), n);
  if (poses) {
    std::vector<Pose> pose(n);
    for (py::ssize_t k = 0; k < n; ++k) pose[k] = ToPose(value.data(k, 0));
    FillGaps(time_span, pose, state, options, sd_span);
    for (py::ssize_t k = 0; k < n; ++k) {
      if (state[k] == SampleState::kFilled) FromPose(pose[k], out.mutable_data(k, 0));
    }
  } else {
    std::vector<Eigen::Vector3d> point(n);
    for (py::ssize_t k = 0; k < n; ++k) point[k] = Eigen::Vector3d::Map(value.data(k, 0));
    FillPointGaps(time_span, point, state, options, sd_span);
    for (py::ssize_t k = 0; k < n; ++k) std::copy_n(point[k].data(), 3, out.mutable_data(k, 0));
  }
  py::array_t<uint8_t> states(n);
  for (py::ssize_t k = 0; k < n; ++k) *states.mutable_data(k) = static_cast<uint8_t>(state[k]);
  return py::make_tuple(out, states, sd);
}

CameraModel Camera(const Doubles& intrinsics, int width, int height,
                   const std::array<double, 5>& distortion) {
  CheckShape(intrinsics, "intrinsics", {4});
  CameraModel camera;
  camera.width = width;
  camera.height = height;
  camera.fx = intrinsics.at(0);
  camera.fy = intrinsics.at(1);
  camera.cx = intrinsics.at(2);
  camera.cy = intrinsics.at(3);
  camera.distortion = distortion;
  if (!(camera.fx > 0 && camera.fy > 0)) throw py::value_error("intrinsics: fx and fy must be positive");
  return camera;
}

HandPixels Pixels(const double* uv) {
  HandPixels out;
  for (int i = 0; i < kHandPoints; ++i) out[i] = {uv[2 * i], uv[2 * i + 1]};
  return out;
}

py::tuple ToPython(const HandPoints& hand) {
  py::array_t<double> p({kHandPoints, 3});
  py::array_t<uint8_t> state(kHandPoints);
  for (int i = 0; i < kHandPoints; ++i) {
    std::copy_n(hand.p[i].data(), 3, p.mutable_data(i, 0));
    *state.mutable_data(i) = static_cast<uint8_t>(hand.state[i]);
  }
  return py::make_tuple(p, state);
}

py::tuple Lift(const Doubles& uv, const py::array& depth, const Doubles& intrinsics,
               const std::array<double, 5>& distortion, const std::string& method, double unit,
               double joint_depth) {
  CheckShape(uv, "uv", {kHandPoints, 2});
  LiftOptions options;
  options.joint_depth = joint_depth;
  if (method == "gaussian") {
    options.method = DepthMethod::kGaussian;
  } else if (method != "robust") {
    throw py::value_error("method \"" + method + "\" is not known: robust, gaussian");
  }
  if (depth.ndim() == 1) {
    const auto z = Doubles::ensure(depth);
    CheckShape(z, "depth", {kHandPoints});
    HandDepths depths;
    std::copy_n(z.data(), kHandPoints, depths.begin());
    return ToPython(LiftHand(Camera(intrinsics, 0, 0, distortion), Pixels(uv.data()), depths, options));
  }
  using Image = py::array_t<uint16_t, py::array::c_style>;
  if (!py::isinstance<Image>(depth) || depth.ndim() != 2) {
    throw py::value_error("depth must be a C-contiguous (H, W) array of uint16, or (21,) in m");
  }
  const auto image = py::reinterpret_borrow<Image>(depth);
  const int width = static_cast<int>(image.shape(1)), height = static_cast<int>(image.shape(0));
  const cv::Mat view(height, width, CV_16UC1, const_cast<uint16_t*>(image.data()));
  return ToPython(
      LiftHand(Camera(intrinsics, width, height, distortion), Pixels(uv.data()), view, unit, options));
}

py::tuple Filter(const Doubles& time, const Doubles& uv, const Doubles& p_C, const Bytes& state_C,
                 const Doubles& X_WC, bool fixed_place, bool bones, bool jumps, double max_gap) {
  CheckShape(time, "time", {-1});
  const py::ssize_t n = time.shape(0);
  CheckShape(uv, "uv", {n, kHandPoints, 2});
  CheckShape(p_C, "p_C", {n, kHandPoints, 3});
  CheckShape(state_C, "state", {n, kHandPoints});
  const bool moving = X_WC.ndim() == 2;
  if (moving) {
    CheckShape(X_WC, "X_WC", {n, 7});
  } else {
    CheckShape(X_WC, "X_WC", {7});
  }
  std::vector<HandFrame> frames(n);
  for (py::ssize_t k = 0; k < n; ++k) {
    HandFrame& f = frames[k];
    f.time = time.at(k);
    f.pixels = Pixels(uv.data(k, 0, 0));
    f.X_WC = OneMore(moving ? X_WC.data(k, 0) : X_WC.data(), "X_WC");
    for (int i = 0; i < kHandPoints; ++i) {
      if (state_C.at(k, i) >= kNumPointStates) throw py::value_error("state holds a value that is no state");
      f.hand_C.state[i] = static_cast<PointState>(state_C.at(k, i));
      f.hand_C.p[i] = Eigen::Vector3d::Map(p_C.data(k, i, 0));
      if (f.hand_C.state[i] == PointState::kMeasured && !f.hand_C.p[i].allFinite()) {
        throw py::value_error("p_C: point " + std::to_string(i) + " of frame " + std::to_string(k) +
                              " is not finite");
      }
    }
  }
  HandFilterOptions options;
  options.fixed_place = fixed_place;
  options.bones = bones;
  options.jumps = jumps;
  options.gaps.max_gap = max_gap;
  std::vector<HandPoints> hands;
  {
    py::gil_scoped_release release;
    hands = FilterHand(frames, options);
  }
  py::array_t<double> p({n, py::ssize_t{kHandPoints}, py::ssize_t{3}});
  py::array_t<uint8_t> state({n, py::ssize_t{kHandPoints}});
  for (py::ssize_t k = 0; k < n; ++k) {
    for (int i = 0; i < kHandPoints; ++i) {
      std::copy_n(hands[k].p[i].data(), 3, p.mutable_data(k, i, 0));
      *state.mutable_data(k, i) = static_cast<uint8_t>(hands[k].state[i]);
    }
  }
  return py::make_tuple(p, state);
}

}  // namespace

void Bind_hand(py::module_& m) {
  m.def("fill_gaps", &Fill, "time"_a, "value"_a, "valid"_a, "method"_a = "kalman", "max_gap"_a = 0.5,
        "slerp_gap"_a = 0.4, "sigma"_a = 0.002,
        "Fills gaps of up to max_gap [s] between measurements. time (T,) rising [s]; value (T, 7) poses or "
        "(T, 3) "
        "points;\n"
        "valid (T,) bool: measured. method: kalman (smoother; SLERP, over slerp_gap a rate-fitted log map), "
        "linear "
        "(and\n"
        "SLERP). sigma: of a coordinate of a measured position [m].\n"
        "Returns the value, state (T,) uint8 (0 invalid, 1 measured, 2 filled), and the standard deviation "
        "of a "
        "coordinate\n"
        "of the position (T,) [m]. ValueError for what is no track.");

  py::class_<GapTracker>(m, "GapTracker",
                         "The causal variant of fill_gaps for one object: goes on at first, then holds; the "
                         "covariance grows.")
      .def(py::init([](double max_gap, double sigma, double sigma_angle) {
             GapTrackerOptions o;
             o.max_gap = max_gap;
             o.sigma = sigma;
             o.sigma_angle = sigma_angle;
             return GapTracker(o);
           }),
           "max_gap"_a = 0.5, "sigma"_a = 0.002, "sigma_angle"_a = 0.0175)
      .def(
          "update",
          [](GapTracker& t, double time, const Doubles& pose) {
            CheckShape(pose, "pose", {7});
            return t.Update(time, ToPose(pose.data()));
          },
          "time"_a, "pose"_a, "False, and nothing changes, when time does not rise or the pose is none.")
      .def(
          "predict",
          [](const GapTracker& t, double time) {
            const GapEstimate e = t.Predict(time);
            py::array_t<double> pose(7);
            FromPose(e.pose, pose.mutable_data());
            py::dict out;
            out["pose"] = pose;
            out["sigma"] = e.sigma;
            out["sigma_angle"] = e.sigma_angle;
            out["age"] = e.age;
            out["valid"] = e.valid;
            return out;
          },
          "time"_a, "{pose (7,), sigma [m], sigma_angle [rad] (of a coordinate), age [s], valid}")
      .def("reset", &GapTracker::Reset, "As new.");

  m.def("lift_hand", &Lift, "uv"_a, "depth"_a, "intrinsics"_a, "distortion"_a = std::array<double, 5>{},
        "method"_a = "robust", "unit"_a = 0.001, "joint_depth"_a = LiftOptions().joint_depth,
        "21 key points and their depth -> points in the camera's optical frame. uv (21, 2) px, NaN: not "
        "seen; depth "
        "(H, W)\n"
        "uint16 aligned with the picture, `unit` m a count, 0: none, or (21,) m; intrinsics fx fy cx cy; "
        "method: "
        "robust\n"
        "(median of what lies within 60 mm of the palm), gaussian (the thesis' weighted mean, 11 x 11).\n"
        "Returns p_C (21, 3) [m], state (21,) uint8: hand_states.");
  m.def("filter_hand", &Filter, "time"_a, "uv"_a, "p_C"_a, "state"_a, "X_WC"_a, "fixed_place"_a = true,
        "bones"_a = true, "jumps"_a = true, "max_gap"_a = 0.5,
        "A sequence of lifted hands -> points in W, without what no hand does, short gaps filled. time (T,) "
        "[s]; uv "
        "(T, 21, 2);\n"
        "p_C (T, 21, 3) and state (T, 21) of lift_hand; X_WC (7,) or (T, 7). Returns p_W (T, 21, 3) [m], "
        "zero where "
        "nothing is\n"
        "known, and state (T, 21).");
  py::list names;
  for (const char* name : {"unseen", "measured", "filled", "no_depth", "fixed_place", "bone", "jump"}) {
    names.append(name);
  }
  m.attr("hand_states") = py::tuple(names);
  py::list bones;
  for (const Bone& b : HandBones()) bones.append(py::make_tuple(b.a, b.b, b.length));
  m.attr("hand_bones") = py::tuple(bones);
}

}  // namespace intabs
