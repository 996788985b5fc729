// Weights folder: weights.safetensors and the manifest.json that says what must be in it. Nothing here is
// real-time safe; everything throws std::runtime_error with one line that names file, tensor, found and
// expected.
//
// Manifest, as far as this room reads it:
//   {"schema_version": 1,
//    "sha256": "<of weights.safetensors>",
//    "networks": {"pi": {"input": 40, "input_linear": 128, "layers": 8, "hidden": 128, "residual": true,
//                        "bidirectional": false, "layer_norm": false, "skip": false,
//                        "pool": "last", "format": "fp32",
//                        "heads": {"agent_mean": 7, "env_mean": 12}}}}
// format: "fp32", "16" or "8", how the network runs unless the caller says otherwise. All but input, layers,
// hidden and heads may be left out (0, false, last, fp32). Other keys belong to other rooms, which read them
// through Manifest.
//
// Tensors of network N, torch's names and layout, gates i, f, g, o:
//   N.input.weight (input_linear, input), N.input.bias
//   N.lstm.L.weight_ih (4 hidden, in), .weight_hh (4 hidden, hidden), .bias_ih, .bias_hh (4 hidden)
//     and the same with _reverse for a bidirectional one; in = 2 hidden for its layers >= 1
//   N.lstm.L.norm.weight, .bias (in), L >= 1: only with layer_norm
//   N.heads.HEAD.weight (size, hidden or 2 hidden, with skip + input), .bias
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <map>
#include <memory>
#include <nlohmann/json_fwd.hpp>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "intabs/nn/kernels.h"

namespace intabs {

using RowMatrixXf = Eigen::Matrix<float, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

inline constexpr double kLayerNormEpsilon = 1e-5;  // torch.nn.LayerNorm's

WeightFormat ParseWeightFormat(std::string_view text);  // "fp32", "16", "8"; else throws

struct HeadSpec {
  std::string name;
  int size = 0;
};

struct NetworkSpec {
  int input = 0;
  int input_linear = 0;  // 0: the LSTM sees the input as it is
  int layers = 0;
  int hidden = 0;
  bool residual = false;
  bool bidirectional = false;
  bool layer_norm = false;  // layer >= 1 reads norm(its input); the residual path goes past the norm
  bool skip = false;        // heads read [top layer's output, the network's input]: a linear path beside the LSTM
  bool pool_mean = false;   // "pool": "mean" or "last": what EncodeFinal takes of the heads over a sequence
  WeightFormat format = WeightFormat::kFp32;
  std::vector<HeadSpec> heads;  // in the order of their names

  int lstm_input() const { return input_linear > 0 ? input_linear : input; }
  int layer_output() const { return bidirectional ? 2 * hidden : hidden; }
  int head_input() const { return layer_output() + (skip ? input : 0); }
  int layer_input(int layer) const { return layer == 0 ? lstm_input() : layer_output(); }
};

// manifest.json. Paths are JSON pointers: "/normaliser/mean". A missing or wrong entry throws and names
// itself.
class Manifest {
 public:
  static Manifest Load(const std::string& dir);
  static Manifest Parse(std::string_view text, const std::string& label);  // label: what errors call it
  static Manifest Of(const std::string& name, const NetworkSpec& spec);    // one network, no file

  bool Has(const std::string& path) const;
  double Number(const std::string& path) const;
  int64_t Integer(const std::string& path) const;
  bool Bool(const std::string& path) const;
  std::string Text(const std::string& path) const;
  std::vector<double> Numbers(
      const std::string& path) const;  // nested arrays flattened, row by row; all finite
  std::vector<std::string> Texts(const std::string& path) const;
  std::vector<std::string> Keys(const std::string& path) const;  // of an object, sorted

  const std::vector<std::pair<std::string, NetworkSpec>>& networks() const { return networks_; }
  const NetworkSpec& network(const std::string& name) const;  // unknown: lists the known ones

 private:
  const nlohmann::json& At(const std::string& path) const;
  [[noreturn]] void Fail(const std::string& what) const;

  std::string label_;
  std::shared_ptr<const nlohmann::json> json_;
  std::vector<std::pair<std::string, NetworkSpec>> networks_;
};

enum class Dtype { kF32, kF16, kBF16, kI8 };

struct Tensor {
  Dtype dtype = Dtype::kF32;
  std::vector<int64_t> shape;
  std::span<const uint8_t> bytes;  // into the file's buffer
};

// A safetensors image in memory. Checks the format itself: offsets without holes or overlaps, sizes, names.
class SafeTensors {
 public:
  SafeTensors(std::vector<uint8_t> file, const std::string& label);
  SafeTensors(const SafeTensors&) = delete;  // the tensors point into it
  SafeTensors& operator=(const SafeTensors&) = delete;
  const std::map<std::string, Tensor, std::less<>>& tensors() const { return tensors_; }
  const std::vector<uint8_t>& file() const { return file_; }

 private:
  std::vector<uint8_t> file_;
  std::map<std::string, Tensor, std::less<>> tensors_;
};

// A manifest and its weights, checked against each other: the hash, every tensor wanted is there in its
// shape, every tensor there is wanted, every value finite. F32, F16 and BF16 become float; I8 comes with
// "<tensor>.scale" (F32, one a row; one in all for a bias) and becomes scale * value.
class WeightsFile {
 public:
  static WeightsFile Load(const std::string& dir);
  static WeightsFile Parse(std::vector<uint8_t> safetensors, Manifest manifest, const std::string& label);
  // One network of this shape, called "net", with uniform weights in +-1/sqrt(hidden), torch's initial range.
  static WeightsFile Random(const NetworkSpec& spec, unsigned seed);

  const std::string& label() const { return label_; }  // the folder, for messages
  const Manifest& manifest() const { return manifest_; }
  const RowMatrixXf& tensor(const std::string& name) const {
    return tensors_.at(name);
  }  // a vector is a column

 private:
  std::string label_;
  Manifest manifest_;
  std::map<std::string, RowMatrixXf> tensors_;
};

}  // namespace intabs
