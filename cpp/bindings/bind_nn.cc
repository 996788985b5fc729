#include <pybind11/eigen.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "intabs/nn/network.h"
#include "intabs/nn/reference.h"

namespace py = pybind11;

namespace intabs {
namespace {

// Taken without a copy if it is float32 and contiguous.
using FloatArray = py::array_t<float, py::array::c_style | py::array::forcecast>;

// A read-only array on memory that `owner` owns.
py::array View(const float* data, std::vector<py::ssize_t> shape, py::ssize_t row_stride,
               const py::object& owner) {
  std::vector<py::ssize_t> strides(shape.size(), sizeof(float));
  if (shape.size() == 2) strides[0] = row_stride * static_cast<py::ssize_t>(sizeof(float));
  py::array out(py::dtype::of<float>(), std::move(shape), std::move(strides), data, owner);
  out.attr("setflags")(py::arg("write") = false);
  return out;
}

py::dict Outputs(const py::object& self) {
  const auto& net = self.cast<const Network&>();
  py::dict out;
  for (int i = 0; i < net.num_heads(); ++i) {
    out[py::str(net.head_name(i))] = View(net.Head(i).data(), {net.head_size(i)}, 0, self);
  }
  return out;
}

py::dict Copies(const Network& net) {
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

NetworkOptions Options(const std::optional<std::string>& format, const std::optional<std::string>& isa) {
  NetworkOptions options;
  if (format) options.format = ParseWeightFormat(*format);
  if (isa) {
    bool found = false;
    for (const Isa i : kAllIsas) {
      if (*isa != Name(i)) continue;
      if (!IsSupported(i)) throw py::value_error(*isa + " is not supported by this CPU");
      options.isa = i;
      found = true;
    }
    if (!found) throw py::value_error("unknown instruction set \"" + *isa + "\"; see instruction_sets()");
  }
  return options;
}

// Rollout indices come from Python.
void CheckIndex(const NetworkBatch& b, int j) {
  if (j < 0 || j >= b.size())
    throw py::index_error("rollout " + std::to_string(j) + " of " + std::to_string(b.size()));
}

py::dict BatchOutputs(const py::object& self) {
  const auto& b = self.cast<const NetworkBatch&>();
  py::dict out;
  for (int i = 0; i < b.network().num_heads(); ++i) {
    const auto head = b.Head(i);
    out[py::str(b.network().head_name(i))] =
        View(head.data(), {head.rows(), head.cols()}, head.outerStride(), self);
  }
  return out;
}

}  // namespace

void Bind_nn(py::module_& m) {
  m.def(
      "instruction_sets",
      [] {
        std::vector<std::string> out;
        for (const Isa i : kAllIsas) {
          if (IsSupported(i)) out.emplace_back(Name(i));
        }
        return out;
      },
      "Instruction sets of this CPU that the networks have kernels for; the last one is used.");

  py::class_<Network>(
      m, "Network",
      "A network of a weights folder: [input linear] -> stacked LSTM -> named linear heads, float32.\n"
      "Not for use by several threads at once; copy.copy gives an independent one.")
      .def_static(
          "load",
          [](const std::string& dir, const std::string& name, const std::optional<std::string>& format,
             const std::optional<std::string>& isa) {
            const NetworkOptions options = Options(format, isa);
            py::gil_scoped_release release;
            return Network::Load(dir, name, options);
          },
          py::arg("dir"), py::arg("name"), py::arg("format") = py::none(), py::arg("isa") = py::none(),
          "Network `name` of the folder with weights.safetensors and manifest.json.\n"
          "format: \"fp32\", \"16\" or \"8\", how the LSTM's weights are held; None: as the manifest says.\n"
          "isa: one of instruction_sets(); None: the best. RuntimeError, one line, when anything does not "
          "match.")
      .def("__copy__", [](const Network& n) { return Network(n); })
      .def_property_readonly("input_size", &Network::input_size)
      .def_property_readonly(
          "heads",
          [](const Network& n) {
            py::dict out;
            for (int i = 0; i < n.num_heads(); ++i) out[py::str(n.head_name(i))] = n.head_size(i);
            return out;
          },
          "{name: size}")
      .def_property_readonly("weight_bytes", &Network::weight_bytes, "What one step reads, as packed.")
      .def("reset", &Network::Reset, "Zero state.")
      .def(
          "step",
          [](Network& n, const FloatArray& x) {
            if (x.ndim() != 1 || x.shape(0) != n.input_size()) {
              throw py::value_error("x must be (" + std::to_string(n.input_size()) + ",)");
            }
            switch (n.Step(x.data())) {
              case Status::kOk:
                return Copies(n);
              case Status::kInvalidInput:
                throw py::value_error("x is not finite");
              default:
                throw std::runtime_error("a bidirectional network has no step; use sequence or encode_final");
            }
          },
          py::arg("x"),
          "One tick with carried state. x: (input_size,). Returns {head: (size,)}, copies.\n"
          "ValueError: wrong shape or a value that is not finite; the state is left alone then.")
      .def_property_readonly(
          "outputs", &Outputs,
          "{head: (size,)}: read-only views of the network's own memory. They change with every\n"
          "step and encode_final.")
      .def_property(
          "state",
          [](const Network& n) {
            FloatArray out(n.state_size());
            n.SaveState(out.mutable_data());
            return out;
          },
          [](Network& n, const FloatArray& s) {
            if (s.ndim() != 1 || s.shape(0) != n.state_size()) {
              throw py::value_error("the state must be (" + std::to_string(n.state_size()) + ",)");
            }
            n.RestoreState(s.data());
          },
          "State between ticks, (2 layers hidden,): h of every layer, then c of every layer. A copy.")
      .def(
          "sequence",
          [](Network& n, const FloatArray& X, int threads) {
            const auto x = Trajectory(n, X);
            std::vector<RowMatrixXf> heads;
            {
              py::gil_scoped_release release;
              n.Sequence(x, heads, threads);
            }
            py::dict out;
            for (int i = 0; i < n.num_heads(); ++i) out[py::str(n.head_name(i))] = std::move(heads[i]);
            return out;
          },
          py::arg("X"), py::arg("threads") = 1,
          "A whole trajectory from zero state. X: (T, input_size). Returns {head: (T, size)}.\n"
          "threads=2: one a direction of a bidirectional network. The state of step() is left alone. "
          "Releases the GIL.")
      .def(
          "encode_final",
          [](Network& n, const FloatArray& X, int threads) {
            const auto x = Trajectory(n, X);
            {
              py::gil_scoped_release release;
              n.EncodeFinal(x, threads);
            }
            return Copies(n);
          },
          py::arg("X"), py::arg("threads") = 1,
          "Heads on the top layer's [forward output at T-1, backward output at 0] (on its output at T-1\n"
          "if not bidirectional). X: (T, input_size). Returns {head: (size,)}, copies. Releases the GIL.");

  py::class_<NetworkBatch>(
      m, "NetworkBatch",
      "n states of one network that step together, for planning. Holds a copy of the weights.")
      .def(py::init<const Network&, int>(), py::arg("network"), py::arg("n"),
           "Zero states. ValueError if the network is bidirectional or n < 1.")
      .def("__len__", [](const NetworkBatch& b) { return b.size(); })
      .def(
          "reset", [](NetworkBatch& b) { b.Reset(); }, "Zero states.")
      .def(
          "step",
          [](const py::object& self, const FloatArray& X) {
            auto& b = self.cast<NetworkBatch&>();
            if (X.ndim() != 2 || X.shape(0) != b.size() || X.shape(1) != b.network().input_size()) {
              throw py::value_error("X must be (" + std::to_string(b.size()) + ", " +
                                    std::to_string(b.network().input_size()) + ")");
            }
            Status status;
            {
              py::gil_scoped_release release;
              status = b.Step(X.data());
            }
            if (status != Status::kOk) throw py::value_error("X is not finite");
            return BatchOutputs(self);
          },
          py::arg("X"),
          "One tick of all. X: (n, input_size). Returns {head: (n, size)}: read-only views, which the\n"
          "next step changes. Releases the GIL.")
      .def(
          "state",
          [](const NetworkBatch& b, int j) {
            CheckIndex(b, j);
            FloatArray out(b.network().state_size());
            b.SaveState(j, out.mutable_data());
            return out;
          },
          py::arg("j"), "State of rollout j, laid out as Network.state. A copy.")
      .def(
          "set_state",
          [](NetworkBatch& b, int j, const FloatArray& s) {
            CheckIndex(b, j);
            if (s.ndim() != 1 || s.shape(0) != b.network().state_size()) {
              throw py::value_error("the state must be (" + std::to_string(b.network().state_size()) + ",)");
            }
            b.RestoreState(j, s.data());
          },
          py::arg("j"), py::arg("state"));

  using Reference = ReferenceNetwork<double>;
  py::class_<Reference>(
      m, "ReferenceNetwork",
      "The same networks in double precision and plain Eigen, slowly: what the error of a weight\n"
      "format is measured against.")
      .def_static(
          "load",
          [](const std::string& dir, const std::string& name) {
            py::gil_scoped_release release;
            return Reference(WeightsFile::Load(dir), name);
          },
          py::arg("dir"), py::arg("name"), "As Network.load.")
      .def(
          "sequence",
          [](Reference& n, const Reference::Rows& X) {
            if (X.rows() < 1 || X.cols() != n.spec().input) {
              throw py::value_error("X must be (T, " + std::to_string(n.spec().input) + ") with T >= 1");
            }
            std::vector<Reference::Rows> heads;
            {
              py::gil_scoped_release release;
              n.Sequence(X, heads);
            }
            py::dict out;
            for (size_t i = 0; i < heads.size(); ++i) {
              out[py::str(n.spec().heads[i].name)] = std::move(heads[i]);
            }
            return out;
          },
          py::arg("X"),
          "A whole trajectory from zero state. X: (T, input_size). Returns {head: (T, size)}, float64.");
}

}  // namespace intabs
