// Frame sources for Python: what the estimator of hands reads.
#include <pybind11/functional.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "intabs/camera/frame_source.h"

namespace py = pybind11;
using namespace pybind11::literals;

namespace intabs {
namespace {

class PySource {
 public:
  PySource(const std::string& spec, const std::string& camera, int width, int height,
           std::function<void(const std::string&)> say)
      : say_(std::move(say)),
        source_(OpenSource(spec, {camera, width, height}, [this](const std::string& what) {
          const py::gil_scoped_acquire acquire;
          say_(what);
        })) {}

  py::tuple Next() {
    Grab grab;
    {
      const py::gil_scoped_release release;
      grab = source_->Next(frame_);
    }
    static constexpr const char* kNames[] = {"frame", "none", "lost", "end"};
    py::object rgb = py::none();
    if (grab == Grab::kFrame && !frame_.rgb.empty()) {
      const cv::Mat& m = frame_.rgb;
      py::array_t<uint8_t> copy({m.rows, m.cols, 3});
      for (int y = 0; y < m.rows; ++y) std::copy_n(m.ptr(y), size_t{3} * m.cols, copy.mutable_data(y, 0, 0));
      rgb = copy;
    }
    return py::make_tuple(kNames[static_cast<int>(grab)], frame_.frame_seq, frame_.exposure_us, rgb);
  }

 private:
  std::function<void(const std::string&)> say_;
  std::unique_ptr<FrameSource> source_;
  Frame frame_;
};

}  // namespace

void Bind_frame_source(py::module_& m) {
  py::class_<PySource>(
      m, "FrameSource",
      "Frames of one camera: ring:/NAME, v4l2:DEVICE, realsense:SERIAL, folder:DIR, video:FILE. "
      "RuntimeError, one "
      "line, when\n"
      "there is none. width, height 0: as they come. say(text) hears when a live camera goes and comes.")
      .def(py::init<const std::string&, const std::string&, int, int,
                    std::function<void(const std::string&)>>(),
           "spec"_a, "camera"_a, "width"_a, "height"_a, "say"_a)
      .def("next", &PySource::Next,
           "(what, frame_seq, exposure_us, rgb): what is frame, none (not yet), lost (being looked for) or "
           "end; rgb "
           "(H, W, 3)\n"
           "uint8, None for a frame that cannot be read.");
}

}  // namespace intabs
