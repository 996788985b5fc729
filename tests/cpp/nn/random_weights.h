// Random networks as a weights folder holds them, in memory.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <map>
#include <random>
#include <string>
#include <vector>

#include "intabs/nn/sha256.h"
#include "intabs/nn/weights.h"

namespace intabs {

struct RawTensor {
  std::string dtype;
  std::vector<int64_t> shape;
  std::vector<uint8_t> bytes;
};
using RawTensors = std::map<std::string, RawTensor>;

inline RawTensor RandomTensor(std::vector<int64_t> shape, float bound, std::mt19937& rng) {
  int64_t n = 1;
  for (const int64_t d : shape) n *= d;
  std::uniform_real_distribution<float> value(-bound, bound);
  std::vector<float> v(n);
  for (float& x : v) x = value(rng);
  RawTensor t{"F32", std::move(shape), std::vector<uint8_t>(4 * n)};
  std::memcpy(t.bytes.data(), v.data(), t.bytes.size());
  return t;
}

// Torch's initial range, 1 / sqrt(hidden), times `gain`.
inline RawTensors RandomNetwork(const std::string& net, const NetworkSpec& s, unsigned seed, float gain = 1) {
  std::mt19937 rng(seed);
  const float bound = gain / std::sqrt(static_cast<float>(s.hidden));
  RawTensors out;
  if (s.input_linear > 0) {
    out[net + ".input.weight"] = RandomTensor({s.input_linear, s.input}, bound, rng);
    out[net + ".input.bias"] = RandomTensor({s.input_linear}, bound, rng);
  }
  for (int l = 0; l < s.layers; ++l) {
    for (const std::string end : {"", "_reverse"}) {
      if (!end.empty() && !s.bidirectional) continue;
      const std::string prefix = net + ".lstm." + std::to_string(l) + ".";
      out[prefix + "weight_ih" + end] = RandomTensor({4 * s.hidden, s.layer_input(l)}, bound, rng);
      out[prefix + "weight_hh" + end] = RandomTensor({4 * s.hidden, s.hidden}, bound, rng);
      out[prefix + "bias_ih" + end] = RandomTensor({4 * s.hidden}, bound, rng);
      out[prefix + "bias_hh" + end] = RandomTensor({4 * s.hidden}, bound, rng);
    }
  }
  for (int l = 1; l < s.layers && s.layer_norm; ++l) {
    const std::string prefix = net + ".lstm." + std::to_string(l) + ".norm.";
    out[prefix + "weight"] = RandomTensor({s.layer_input(l)}, 2, rng);
    out[prefix + "bias"] = RandomTensor({s.layer_input(l)}, 1, rng);
  }
  for (const HeadSpec& h : s.heads) {
    out[net + ".heads." + h.name + ".weight"] = RandomTensor({h.size, s.head_input()}, bound, rng);
    out[net + ".heads." + h.name + ".bias"] = RandomTensor({h.size}, bound, rng);
  }
  return out;
}

inline std::vector<uint8_t> WithHeader(const std::string& header, const std::vector<uint8_t>& data) {
  std::vector<uint8_t> file(8 + header.size() + data.size());
  for (int i = 0; i < 8; ++i) file[i] = static_cast<uint8_t>(uint64_t{header.size()} >> (8 * i));
  std::copy(data.begin(), data.end(), std::copy(header.begin(), header.end(), file.begin() + 8));
  return file;
}

inline std::vector<uint8_t> SafeTensorsImage(const RawTensors& tensors) {
  std::string header = "{";
  std::vector<uint8_t> data;
  for (const auto& [name, t] : tensors) {
    std::string shape;
    for (const int64_t d : t.shape) {
      if (!shape.empty()) shape += ",";
      shape += std::to_string(d);
    }
    if (header.size() > 1) header += ",";
    header += "\"" + name + "\":{\"dtype\":\"" + t.dtype + "\",\"shape\":[" + shape + "],\"data_offsets\":[" +
              std::to_string(data.size()) + "," + std::to_string(data.size() + t.bytes.size()) + "]}";
    data.insert(data.end(), t.bytes.begin(), t.bytes.end());
  }
  return WithHeader(header + "}", data);
}

inline std::string ManifestText(const std::map<std::string, NetworkSpec>& networks, const std::string& sha256,
                                const std::string& extra = "") {
  std::string out = "{\"schema_version\":1,\"sha256\":\"" + sha256 + "\"," + extra + "\"networks\":{";
  bool first = true;
  for (const auto& [name, s] : networks) {
    out += std::string(first ? "" : ",") + "\"" + name + "\":{\"input\":" + std::to_string(s.input) +
           ",\"input_linear\":" + std::to_string(s.input_linear) + ",\"layers\":" + std::to_string(s.layers) +
           ",\"hidden\":" + std::to_string(s.hidden) + ",\"residual\":" + (s.residual ? "true" : "false") +
           ",\"bidirectional\":" + (s.bidirectional ? "true" : "false") +
           ",\"layer_norm\":" + (s.layer_norm ? "true" : "false") + ",\"skip\":" + (s.skip ? "true" : "false") +
           ",\"pool\":\"" + (s.pool_mean ? "mean" : "last") + "\",\"format\":\"" +
           (s.format == WeightFormat::kFp32 ? "fp32"
            : s.format == WeightFormat::k16 ? "16"
                                            : "8") +
           "\",\"heads\":{";
    for (size_t i = 0; i < s.heads.size(); ++i) {
      if (i > 0) out += ",";
      out += "\"" + s.heads[i].name + "\":" + std::to_string(s.heads[i].size);
    }
    out += "}}";
    first = false;
  }
  return out + "}}";
}

inline WeightsFile MakeWeights(const std::map<std::string, NetworkSpec>& networks,
                               const RawTensors& tensors) {
  std::vector<uint8_t> image = SafeTensorsImage(tensors);
  const std::string sha = Sha256Hex(image.data(), image.size());
  return WeightsFile::Parse(
      std::move(image), Manifest::Parse(ManifestText(networks, sha), "weights/t/manifest.json"), "weights/t");
}

inline WeightsFile MakeRandomWeights(const NetworkSpec& spec, unsigned seed, float gain = 1) {
  return MakeWeights({{"net", spec}}, RandomNetwork("net", spec, seed, gain));
}

}  // namespace intabs
