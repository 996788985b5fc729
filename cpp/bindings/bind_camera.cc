// The frame ring for Python: tests that play the camera, and looking at what a plant's cameras see.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <memory>
#include <optional>

#include "intabs/camera/frame_ring.h"

namespace py = pybind11;

namespace intabs {
namespace {

struct Writer {
  std::unique_ptr<FrameRingWriter> ring;
  int cameras, width, height;
};

}  // namespace

void Bind_camera(py::module_& m) {
  py::class_<Writer>(m, "FrameRingWriter", "A ring of frames in shared memory; it goes with this object.")
      .def(py::init(
               [](const std::string& name, const std::vector<std::string>& cameras, int width, int height,
                  bool depth) {
                 return Writer{std::make_unique<FrameRingWriter>(name, cameras, width, height,
                                                                 FrameRingWriter::kDefaultSlots, depth),
                               static_cast<int>(cameras.size()), width, height};
               }),
           py::arg("name"), py::arg("cameras"), py::arg("width"), py::arg("height"), py::arg("depth") = false)
      .def(
          "write",
          [](Writer& w, int camera, int64_t frame_seq, int64_t exposure_us,
             const py::array_t<uint8_t, py::array::c_style>& rgb,
             const std::optional<py::array_t<uint16_t, py::array::c_style>>& depth) {
            if (rgb.ndim() != 3 || rgb.shape(0) != w.height || rgb.shape(1) != w.width || rgb.shape(2) != 3)
              throw py::value_error("the picture must be (H, W, 3) uint8 of the ring's size");
            if (depth && (depth->ndim() != 2 || depth->shape(0) != w.height || depth->shape(1) != w.width))
              throw py::value_error("the depth must be (H, W) uint16 of the ring's size");
            if (camera < 0 || camera >= w.cameras || frame_seq < 1)
              throw py::value_error("no such camera, or frame_seq below 1");
            w.ring->Write(camera, frame_seq, exposure_us, rgb.data(), depth ? depth->data() : nullptr);
          },
          py::arg("camera"), py::arg("frame_seq"), py::arg("exposure_us"), py::arg("rgb"),
          py::arg("depth") = py::none(),
          "rgb (H, W, 3) uint8; depth (H, W) uint16 mm, in a ring that has it.");

  py::class_<FrameRingReader>(m, "FrameRingReader", "RuntimeError, one line, when there is no such ring.")
      .def(py::init<const std::string&>(), py::arg("name"))
      .def_property_readonly("cameras", &FrameRingReader::cameras)
      .def_property_readonly("newest_seq", &FrameRingReader::newest_seq)
      .def(
          "read",
          [](const FrameRingReader& ring, int64_t frame_seq, int camera) -> py::object {
            Frame frame;
            if (ring.Read(frame_seq, camera, frame) != FrameRead::kWhole) return py::none();
            py::array_t<uint8_t> rgb({frame.rgb.rows, frame.rgb.cols, 3});
            std::copy_n(frame.rgb.data, frame.rgb.total() * 3, rgb.mutable_data());
            return py::make_tuple(frame.exposure_us, rgb);
          },
          py::arg("frame_seq"), py::arg("camera"),
          "(exposure_us, (H, W, 3) uint8), or None when it is not there.");
}

}  // namespace intabs
