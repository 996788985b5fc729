#include <pybind11/eigen.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "intabs/nn/network.h"

namespace py = pybind11;

namespace intabs {
namespace {

using FloatArray = py::array_t<float, py::array::c_style | py::array::forcecast>;

py::dict Heads(const Network& net) {
  py::dict out;
  for (int i = 0; i < net.num_heads(); ++i) {
    out[py::str(net.head_name(i))] = FloatArray(net.head_size(i), net.Head(i).data());
  }
  return out;
}

// A wrong shape raises ValueError before anything is read.
Eigen::Map<const RowMatrixXf> Trajectory(const Network& net, const FloatArray& X) {
  if (X.ndim() != 2 || X.shape(0) < 1 || X.shape(1) != net.input_size()) {
    throw py::value_error("X must be (T, " + std::to_string(net.input_size()) + ") with T >= 1");
  }
  return {X.data(), X.shape(0), X.shape(1)};
}

}  // namespace

void Bind_nn(py::module_& m) {
  py::class_<Network>(m, "Network",
                      "A network of a weights folder: [input linear] -> stacked LSTM -> named linear heads, float32.\n"
                      "Not for use by several threads at once; copy.copy gives an independent one.")
      .def_static("load", &Network::Load, py::arg("dir"), py::arg("name"), py::call_guard<py::gil_scoped_release>(),
                  "Network `name` of the folder with weights.safetensors and manifest.json.\n"
                  "RuntimeError, one line, when anything in them does not match.")
      .def("__copy__", [](const Network& n) { return Network(n); })
      .def_property_readonly("input_size", &Network::input_size)
      .def_property_readonly("heads", [](const Network& n) {
        py::dict out;
        for (int i = 0; i < n.num_heads(); ++i) out[py::str(n.head_name(i))] = n.head_size(i);
        return out;
      }, "{name: size}")
      .def("reset", &Network::Reset, "Zero state.")
      .def("step", [](Network& n, const FloatArray& x) {
        if (x.ndim() != 1 || x.shape(0) != n.input_size()) {
          throw py::value_error("x must be (" + std::to_string(n.input_size()) + ",)");
        }
        switch (n.Step(x.data())) {
          case Status::kOk: return Heads(n);
          case Status::kInvalidInput: throw py::value_error("x is not finite");
          default: throw std::runtime_error("a bidirectional network has no step; use sequence or encode_final");
        }
      }, py::arg("x"), "One tick with carried state. x: (input_size,). Returns {head: (size,)}, copies.")
      .def_property("state", [](const Network& n) {
        FloatArray out(n.state_size());
        n.SaveState(out.mutable_data());
        return out;
      }, [](Network& n, const FloatArray& s) {
        if (s.ndim() != 1 || s.shape(0) != n.state_size()) {
          throw py::value_error("the state must be (" + std::to_string(n.state_size()) + ",)");
        }
        n.RestoreState(s.data());
      }, "State between ticks, (2 layers hidden,): h of every layer, then c of every layer.")
      .def("sequence", [](Network& n, const FloatArray& X) {
        const auto x = Trajectory(n, X);
        std::vector<RowMatrixXf> heads;
        {
          py::gil_scoped_release release;
          n.Sequence(x, heads);
        }
        py::dict out;
        for (int i = 0; i < n.num_heads(); ++i) out[py::str(n.head_name(i))] = std::move(heads[i]);
        return out;
      }, py::arg("X"), "A whole trajectory from zero state. X: (T, input_size). Returns {head: (T, size)}.\n"
                       "The state of step() is left alone.")
      .def("encode_final", [](Network& n, const FloatArray& X) {
        const auto x = Trajectory(n, X);
        {
          py::gil_scoped_release release;
          n.EncodeFinal(x);
        }
        return Heads(n);
      }, py::arg("X"), "Heads on the top layer's [forward output at T-1, backward output at 0] (on its output at T-1\n"
                       "if not bidirectional). X: (T, input_size). Returns {head: (size,)}.");
}

}  // namespace intabs
