// Pipeline for Python: dataset preprocessing and in-process rollouts. A pose is an array (7,): x y z [m],
// then the quaternion w x y z.
#include <pybind11/eigen.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <opencv2/core.hpp>

#include "intabs/perception/pipeline.h"

namespace py = pybind11;

namespace intabs {
namespace {

using Image = py::array_t<uint8_t, py::array::c_style>;

py::array_t<double> ToArray(const Pose& X) {
  py::array_t<double> out(7);
  double* v = out.mutable_data();
  std::copy_n(X.p.data(), 3, v);
  v[3] = X.q.w();
  std::copy_n(X.q.vec().data(), 3, v + 4);
  return out;
}

// Grey (H, W) as it is, RGB (H, W, 3) converted; None: the camera gave nothing. Keeps no reference to
// Python's memory.
cv::Mat ToGray(const py::handle& h) {
  if (h.is_none()) return {};
  if (!py::isinstance<Image>(h))
    throw py::value_error("an image must be a C-contiguous numpy array of uint8");
  const auto image = py::reinterpret_borrow<Image>(h);
  const bool rgb = image.ndim() == 3 && image.shape(2) == 3;
  if (!rgb && image.ndim() != 2) throw py::value_error("an image must be (H, W) grey or (H, W, 3) RGB");
  const cv::Mat view(static_cast<int>(image.shape(0)), static_cast<int>(image.shape(1)),
                     rgb ? CV_8UC3 : CV_8UC1, const_cast<uint8_t*>(image.data()));
  if (!rgb) return view.clone();
  cv::Mat gray;
  RgbToGray(view, gray);
  return gray;
}

py::list Tags(const TagDetections& d) {
  py::list out;
  for (int i = 0; i < d.n; ++i) {
    const TagDetection& t = d.tags[i];
    py::array_t<float> corners({4, 2});
    for (int k = 0; k < 4; ++k) std::copy_n(t.corners[k].data(), 2, corners.mutable_data(k));
    py::dict tag;
    tag["id"] = t.id;
    tag["corners"] = corners;
    tag["X_CT"] = py::make_tuple(ToArray(t.X_CT[0]), ToArray(t.X_CT[1]));
    tag["reprojection_px"] = py::make_tuple(t.reprojection_px[0], t.reprojection_px[1]);
    tag["ambiguity"] = t.ambiguity;
    tag["decision_margin"] = t.decision_margin;
    out.append(tag);
  }
  return out;
}

py::dict Poses(const ObjectPoses& poses) {
  py::array_t<int32_t> id(kMaxObjects);
  py::array_t<double> pose({kMaxObjects, 7});
  py::array_t<float> covariance({kMaxObjects, 21});
  py::array_t<uint8_t> cameras(kMaxObjects);
  py::array_t<bool> valid(kMaxObjects);
  py::array_t<float> age(kMaxObjects);
  for (int i = 0; i < kMaxObjects; ++i) {
    const TrackedObject& o = poses.objects[i];
    *id.mutable_data(i) = o.id;
    std::copy_n(ToArray(o.X_WO).data(), 7, pose.mutable_data(i));
    std::copy_n(o.covariance.data(), 21, covariance.mutable_data(i));
    *cameras.mutable_data(i) = o.cameras;
    *valid.mutable_data(i) = o.valid;
    *age.mutable_data(i) = o.age;
  }
  py::dict out;
  out["frame_seq"] = poses.frame_seq;
  out["exposure_us"] = poses.exposure_utime;
  out["id"] = id;
  out["pose"] = pose;
  out["covariance"] = covariance;
  out["cameras"] = cameras;
  out["valid"] = valid;
  out["age"] = age;
  return out;
}

py::dict Process(Pipeline& pipeline, const py::list& images, int64_t frame_seq, int64_t exposure_us) {
  GrayImages gray;
  for (const py::handle& h : images) gray.push_back(ToGray(h));
  ObjectPoses poses;
  CameraDetections detections;
  {
    py::gil_scoped_release release;
    pipeline.Process(gray, frame_seq, exposure_us, poses, detections);
  }
  py::dict tags;
  for (size_t c = 0; c < gray.size(); ++c)
    tags[py::str(pipeline.config().cameras[c].name)] = Tags(detections[c]);
  py::dict out = Poses(poses);
  out["tags"] = tags;
  return out;
}

}  // namespace

void Bind_perception(py::module_& m) {
  py::class_<Pipeline>(
      m, "Pipeline",
      "Camera frames in, object poses in W out: the code of intabs_perception. Not for use by several "
      "threads at once.\n"
      "RuntimeError, one line, when the YAML file (models/config/perception.yaml) does not hold.")
      .def(py::init([](const std::string& path, int threads, bool revisable) {
             return Pipeline(LoadPerceptionConfig(path), {.threads = threads, .revisable = revisable});
           }),
           py::arg("config"), py::arg("threads") = 1, py::arg("revisable") = false)
      .def("process", &Process, py::arg("images"), py::arg("frame_seq"), py::arg("exposure_us"),
           "One frame of all cameras. images: one a camera, in the configuration's order, (H, W) grey or (H, "
           "W, 3) RGB\n"
           "uint8, or None. Returns a dict, by slot: id (4,) (-1: unused or never seen), pose (4, 7) p_WO "
           "[m] and q_WO\n"
           "wxyz, covariance (4, 21) (core/types.h), cameras (4,) bits, valid (4,), age (4,) [s]; and tags: "
           "{camera:\n"
           "[{id, corners (4, 2) px, X_CT: two hypotheses (7,), reprojection_px, ambiguity, "
           "decision_margin}]}.\n"
           "A pose not seen is foretold for 0.5 s, with growing covariance, then invalid. RuntimeError for "
           "images that do\n"
           "not fit the configuration.")
      .def(
          "revised",
          [](const Pipeline& p) {
            py::list out;
            for (const ObjectPoses& poses : p.Revised()) out.append(Poses(poses));
            return out;
          },
          "The poses of all frames since the last reset, decided anew with the frames after them in view, "
          "gaps of up to 0.5 s\nfilled: for datasets. A list\n"
          "of dicts as process() gives them, without tags; empty unless made with revisable=True.")
      .def("reset", &Pipeline::Reset, "As new.")
      .def("redo_extrinsics", &Pipeline::RedoExtrinsics,
           "Finds the places of the cameras anew; poses are kept.")
      .def_property_readonly(
          "cameras",
          [](const Pipeline& p) {
            py::list names;
            for (const CameraModel& c : p.config().cameras) names.append(c.name);
            return names;
          },
          "Names of the cameras, in the order of the images.")
      .def(
          "camera_pose",
          [](const Pipeline& p, int camera) -> py::object {
            if (camera < 0 || camera >= static_cast<int>(p.config().cameras.size())) {
              throw py::index_error("no camera " + std::to_string(camera));
            }
            const auto X_WC = p.X_WC(camera);
            return X_WC ? py::object(ToArray(*X_WC)) : py::object(py::none());
          },
          py::arg("camera"), "X_WC (7,) of the camera's optical frame; None until the ground tag was seen.");
}

}  // namespace intabs
