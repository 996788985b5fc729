#include "intabs/nn/weights.h"

#include <algorithm>
#include <bit>
#include <cerrno>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <limits>
#include <nlohmann/json.hpp>
#include <random>
#include <set>
#include <stdexcept>

#include "intabs/nn/sha256.h"

namespace intabs {
namespace {

using nlohmann::json;

[[noreturn]] void Throw(const std::string& label, const std::string& what) {
  throw std::runtime_error(label + ": " + what);
}

// Names come from files: keep a message to one readable line.
std::string Quoted(std::string_view name) {
  std::string out = "\"";
  for (const char c : name.substr(0, 100)) out += c >= 32 && c < 127 && c != '"' ? c : '?';
  return out + (name.size() > 100 ? "...\"" : "\"");
}

std::vector<uint8_t> ReadFile(const std::string& path) {
  const std::unique_ptr<std::FILE, int (*)(std::FILE*)> f(std::fopen(path.c_str(), "rb"), &std::fclose);
  if (!f) Throw(path, std::string("cannot be opened (") + std::strerror(errno) + ")");
  std::vector<uint8_t> bytes;
  size_t used = 0;
  for (;;) {
    bytes.resize(std::max<size_t>(1 << 16, 2 * used));
    const size_t n = std::fread(bytes.data() + used, 1, bytes.size() - used, f.get());
    used += n;
    if (n == 0) break;
  }
  if (std::ferror(f.get())) Throw(path, std::string("cannot be read (") + std::strerror(errno) + ")");
  bytes.resize(used);
  return bytes;
}

// Duplicate keys are where two readers of one file would see different things.
json ParseJson(std::string_view text, const std::string& label) {
  std::vector<std::set<std::string>> keys;
  std::string duplicate;
  const json::parser_callback_t watch = [&](int, json::parse_event_t event, json& parsed) {
    if (event == json::parse_event_t::object_start) keys.emplace_back();
    if (event == json::parse_event_t::object_end && !keys.empty()) keys.pop_back();
    if (event == json::parse_event_t::key && !keys.empty()) {
      const auto& key = parsed.get_ref<const std::string&>();
      if (!keys.back().insert(key).second && duplicate.empty()) duplicate = key;
    }
    return true;
  };
  json result = json::parse(text.begin(), text.end(), watch, /*allow_exceptions=*/false);
  if (result.is_discarded()) Throw(label, "is not valid JSON");
  if (!result.is_object()) Throw(label, "is not a JSON object");
  if (!duplicate.empty()) Throw(label, "names " + Quoted(duplicate) + " twice");
  return result;
}

std::string ShapeText(const std::vector<int64_t>& shape) {
  if (shape.empty()) return "a scalar";
  std::string out;
  for (const int64_t d : shape) {
    if (!out.empty()) out += 'x';
    out += std::to_string(d);
  }
  return out;
}

const char* Name(Dtype d) {
  switch (d) {
    case Dtype::kF32:
      return "F32";
    case Dtype::kF16:
      return "F16";
    case Dtype::kBF16:
      return "BF16";
    case Dtype::kI8:
      return "I8";
  }
  return "?";
}

int64_t Bytes(Dtype d) { return d == Dtype::kF32 ? 4 : d == Dtype::kI8 ? 1 : 2; }

float HalfToFloat(uint16_t h) {
  const uint32_t sign = uint32_t{h & 0x8000u} << 16;
  const uint32_t exponent = h >> 10 & 31, mantissa = h & 1023;
  if (exponent == 31) return std::bit_cast<float>(sign | 0x7f800000u | mantissa << 13);
  if (exponent == 0) return std::copysign(std::ldexp(static_cast<float>(mantissa), -24), sign ? -1.0f : 1.0f);
  return std::bit_cast<float>(sign | (exponent + 112) << 23 | mantissa << 13);
}

// Little-endian on disk; assembled by bytes, so also right elsewhere.
float Value(const Tensor& t, int64_t i) {
  const uint8_t* p = t.bytes.data() + i * Bytes(t.dtype);
  switch (t.dtype) {
    case Dtype::kF32:
      return std::bit_cast<float>(uint32_t{p[0]} | uint32_t{p[1]} << 8 | uint32_t{p[2]} << 16 |
                                  uint32_t{p[3]} << 24);
    case Dtype::kF16:
      return HalfToFloat(static_cast<uint16_t>(p[0] | p[1] << 8));
    case Dtype::kBF16:
      return std::bit_cast<float>(uint32_t{p[0]} << 16 | uint32_t{p[1]} << 24);
    case Dtype::kI8:
      return static_cast<float>(static_cast<int8_t>(p[0]));
  }
  return 0;
}

struct Wanted {
  std::string name;
  int rows = 0;
  int cols = 0;  // 0: a vector of `rows`
};

std::vector<Wanted> WantedTensors(const std::string& net, const NetworkSpec& s) {
  std::vector<Wanted> out;
  if (s.input_linear > 0) {
    out.push_back({net + ".input.weight", s.input_linear, s.input});
    out.push_back({net + ".input.bias", s.input_linear});
  }
  for (int l = 0; l < s.layers; ++l) {
    const std::string prefix = net + ".lstm." + std::to_string(l) + ".";
    for (const char* direction : {"", "_reverse"}) {
      if (*direction != 0 && !s.bidirectional) continue;
      out.push_back({prefix + "weight_ih" + direction, 4 * s.hidden, s.layer_input(l)});
      out.push_back({prefix + "weight_hh" + direction, 4 * s.hidden, s.hidden});
      out.push_back({prefix + "bias_ih" + direction, 4 * s.hidden});
      out.push_back({prefix + "bias_hh" + direction, 4 * s.hidden});
    }
  }
  for (int l = 1; l < s.layers && s.layer_norm; ++l) {
    const std::string prefix = net + ".lstm." + std::to_string(l) + ".norm.";
    out.push_back({prefix + "weight", s.layer_input(l)});
    out.push_back({prefix + "bias", s.layer_input(l)});
  }
  for (const HeadSpec& h : s.heads) {
    out.push_back({net + ".heads." + h.name + ".weight", h.size, s.head_input()});
    out.push_back({net + ".heads." + h.name + ".bias", h.size});
  }
  return out;
}

}  // namespace

WeightFormat ParseWeightFormat(std::string_view text) {
  if (text == "fp32") return WeightFormat::kFp32;
  if (text == "16") return WeightFormat::k16;
  if (text == "8") return WeightFormat::k8;
  throw std::runtime_error("weight format " + Quoted(text) +
                           " is unknown; there are \"fp32\", \"16\" and \"8\"");
}

// ----------------------------------------------------------------------------------------------------------
// Manifest

void Manifest::Fail(const std::string& what) const { Throw(label_, what); }

Manifest Manifest::Load(const std::string& dir) {
  const std::string path = dir + "/manifest.json";
  const std::vector<uint8_t> bytes = ReadFile(path);
  return Parse({reinterpret_cast<const char*>(bytes.data()), bytes.size()}, path);
}

Manifest Manifest::Parse(std::string_view text, const std::string& label) {
  Manifest m;
  m.label_ = label;
  m.json_ = std::make_shared<const json>(ParseJson(text, label));
  if (const int64_t version = m.Integer("/schema_version"); version != 1) {
    m.Fail("schema_version is " + std::to_string(version) + ", this program reads 1");
  }
  const json& networks = m.At("/networks");
  if (!networks.is_object() || networks.empty())
    m.Fail("\"/networks\" must be an object with at least one network");
  for (const auto& item : networks.items()) {
    const std::string& name = item.key();
    const json& entry = item.value();
    const std::string where = "network " + Quoted(name);
    if (!entry.is_object()) m.Fail(where + " is not an object");
    const auto integer = [&](const char* key, int low, int high, int otherwise) {
      const auto it = entry.find(key);
      if (it == entry.end() && otherwise >= 0) return otherwise;
      if (it == entry.end()) m.Fail(where + ": \"" + key + "\" is missing");
      const bool fits = it->is_number_integer() &&
                        (!it->is_number_unsigned() || it->get<uint64_t>() <= static_cast<uint64_t>(high));
      if (!fits || it->get<int64_t>() < low || it->get<int64_t>() > high) {
        m.Fail(where + ": \"" + key + "\" must be a whole number from " + std::to_string(low) + " to " +
               std::to_string(high));
      }
      return it->get<int>();
    };
    const auto boolean = [&](const char* key) {
      const auto it = entry.find(key);
      if (it == entry.end()) return false;
      if (!it->is_boolean()) m.Fail(where + ": \"" + key + "\" must be true or false");
      return it->get<bool>();
    };
    NetworkSpec s;
    s.input = integer("input", 1, 65536, -1);
    s.input_linear = integer("input_linear", 0, 65536, 0);
    s.layers = integer("layers", 1, 256, -1);
    s.hidden = integer("hidden", 1, 16384, -1);
    s.residual = boolean("residual");
    s.bidirectional = boolean("bidirectional");
    s.layer_norm = boolean("layer_norm");
    s.skip = boolean("skip");
    if (const auto pool = entry.find("pool"); pool != entry.end()) {
      if (*pool != "mean" && *pool != "last") m.Fail(where + ": \"pool\" must be \"mean\" or \"last\"");
      s.pool_mean = *pool == "mean";
    }
    if (const auto format = entry.find("format"); format != entry.end()) {
      if (!format->is_string()) m.Fail(where + ": \"format\" must be \"fp32\", \"16\" or \"8\"");
      s.format = ParseWeightFormat(format->get<std::string>());
    }
    for (const auto& [key, value] : entry.items()) {
      static const std::set<std::string> known = {"input",      "input_linear", "layers", "hidden",
                                                  "residual",   "bidirectional", "layer_norm", "skip",
                                                  "pool",       "format",        "heads"};
      if (!known.contains(key)) m.Fail(where + ": unknown key " + Quoted(key));
    }
    const auto heads = entry.find("heads");
    if (heads == entry.end() || !heads->is_object())
      m.Fail(where + ": \"heads\" must be an object {name: size}");
    for (const auto& [head, size] : heads->items()) {
      if (!size.is_number_integer() || size.get<double>() < 1 || size.get<double>() > 65536) {
        m.Fail(where + ": the size of head " + Quoted(head) + " must be a whole number from 1 to 65536");
      }
      s.heads.push_back({head, size.get<int>()});
    }
    m.networks_.emplace_back(name, std::move(s));
  }
  return m;
}

Manifest Manifest::Of(const std::string& name, const NetworkSpec& spec) {
  Manifest m;
  m.label_ = "(in memory)";
  m.json_ = std::make_shared<const json>(json::object());
  m.networks_.emplace_back(name, spec);
  return m;
}

const NetworkSpec& Manifest::network(const std::string& name) const {
  std::string known;
  for (const auto& [n, spec] : networks_) {
    if (n == name) return spec;
    known += (known.empty() ? "" : ", ") + n;
  }
  Fail("has no network " + Quoted(name) + "; it has " + known);
}

bool Manifest::Has(const std::string& path) const { return json_->contains(json::json_pointer(path)); }

const json& Manifest::At(const std::string& path) const {
  if (!Has(path)) Fail("has no " + Quoted(path));
  return json_->at(json::json_pointer(path));
}

double Manifest::Number(const std::string& path) const {
  const json& v = At(path);
  if (!v.is_number() || !std::isfinite(v.get<double>())) Fail(Quoted(path) + " is not a finite number");
  return v.get<double>();
}

int64_t Manifest::Integer(const std::string& path) const {
  const json& v = At(path);
  if (!v.is_number_integer() || std::abs(v.get<double>()) > 9e15)
    Fail(Quoted(path) + " is not a whole number");
  return v.get<int64_t>();
}

bool Manifest::Bool(const std::string& path) const {
  const json& v = At(path);
  if (!v.is_boolean()) Fail(Quoted(path) + " is not true or false");
  return v.get<bool>();
}

std::string Manifest::Text(const std::string& path) const {
  const json& v = At(path);
  if (!v.is_string()) Fail(Quoted(path) + " is not a text");
  return v.get<std::string>();
}

std::vector<double> Manifest::Numbers(const std::string& path) const {
  std::vector<double> out;
  const auto walk = [&](const auto& self, const json& v) -> void {
    if (v.is_array()) {
      for (const json& e : v) self(self, e);
    } else if (v.is_number() && std::isfinite(v.get<double>())) {
      out.push_back(v.get<double>());
    } else {
      Fail(Quoted(path) + " holds something that is not a finite number");
    }
  };
  const json& v = At(path);
  if (!v.is_array()) Fail(Quoted(path) + " is not a list of numbers");
  walk(walk, v);
  return out;
}

std::vector<std::string> Manifest::Texts(const std::string& path) const {
  const json& v = At(path);
  std::vector<std::string> out;
  if (!v.is_array()) Fail(Quoted(path) + " is not a list of texts");
  for (const json& e : v) {
    if (!e.is_string()) Fail(Quoted(path) + " holds something that is not a text");
    out.push_back(e.get<std::string>());
  }
  return out;
}

std::vector<std::string> Manifest::Keys(const std::string& path) const {
  const json& v = At(path);
  if (!v.is_object()) Fail(Quoted(path) + " is not an object");
  std::vector<std::string> out;
  for (const auto& [key, value] : v.items()) out.push_back(key);
  return out;
}

// -------------------------------------------------------------------------------------------------------
// SafeTensors

SafeTensors::SafeTensors(std::vector<uint8_t> file, const std::string& label) : file_(std::move(file)) {
  if (file_.size() < 8) {
    Throw(label, "is cut: " + std::to_string(file_.size()) + " bytes, a safetensors file has at least 8");
  }
  uint64_t header_size = 0;
  for (int i = 0; i < 8; ++i) header_size |= uint64_t{file_[i]} << (8 * i);
  if (header_size > 100'000'000)
    Throw(label, "is not a safetensors file (header of " + std::to_string(header_size) + " bytes)");
  if (header_size > file_.size() - 8) {
    Throw(label, "is cut: " + std::to_string(file_.size()) + " bytes, its header alone needs " +
                     std::to_string(header_size + 8));
  }
  const json header =
      ParseJson({reinterpret_cast<const char*>(file_.data()) + 8, header_size}, label + ": header");
  const std::span<const uint8_t> data = std::span<const uint8_t>(file_).subspan(8 + header_size);

  std::map<uint64_t, std::pair<uint64_t, std::string>> ranges;  // begin -> end, name
  for (const auto& [name, entry] : header.items()) {
    if (name == "__metadata__") continue;
    const std::string where = "tensor " + Quoted(name);
    if (!entry.is_object() || !entry.contains("dtype") || !entry.contains("shape") ||
        !entry.contains("data_offsets")) {
      Throw(label, where + ": the header lacks dtype, shape or data_offsets");
    }
    Tensor t;
    const json& dtype = entry["dtype"];
    if (dtype == "F32")
      t.dtype = Dtype::kF32;
    else if (dtype == "F16")
      t.dtype = Dtype::kF16;
    else if (dtype == "BF16")
      t.dtype = Dtype::kBF16;
    else if (dtype == "I8")
      t.dtype = Dtype::kI8;
    else
      Throw(label, where + " has dtype " + (dtype.is_string() ? Quoted(dtype.get<std::string>()) : "?") +
                       ", wanted F32, F16, BF16 or I8");
    const auto whole = [&](const json& v) {
      if (!v.is_number_unsigned() || v.get<uint64_t>() > (uint64_t{1} << 40)) {
        Throw(label, where + ": shape and data_offsets must be whole numbers");
      }
      return v.get<uint64_t>();
    };
    uint64_t bytes = Bytes(t.dtype);
    if (!entry["shape"].is_array()) Throw(label, where + ": shape is not a list");
    for (const json& d : entry["shape"]) {
      const uint64_t n = whole(d);
      if (n == 0 || bytes > (uint64_t{1} << 40) / n) Throw(label, where + ": shape is empty or too large");
      bytes *= n;
      t.shape.push_back(static_cast<int64_t>(n));
    }
    const json& offsets = entry["data_offsets"];
    if (!offsets.is_array() || offsets.size() != 2) Throw(label, where + ": data_offsets is not a pair");
    const uint64_t begin = whole(offsets[0]), end = whole(offsets[1]);
    if (end < begin || end - begin != bytes) {
      Throw(label, where + " takes " + std::to_string(end - std::min(begin, end)) + " bytes, its shape " +
                       ShapeText(t.shape) + " " + Name(t.dtype) + " needs " + std::to_string(bytes));
    }
    if (end > data.size()) {
      Throw(label, "is cut: " + where + " ends at byte " + std::to_string(end) + " of the data, " +
                       std::to_string(data.size()) + " are there");
    }
    t.bytes = data.subspan(begin, bytes);
    if (!ranges.emplace(begin, std::pair(end, name)).second) {
      Throw(label, where + " shares its bytes with tensor " + Quoted(ranges[begin].second));
    }
    tensors_.emplace(name, std::move(t));
  }
  uint64_t at = 0;
  for (const auto& [begin, range] : ranges) {
    if (begin != at)
      Throw(label, "tensor " + Quoted(range.second) + " begins at byte " + std::to_string(begin) +
                       " of the data, wanted " + std::to_string(at));
    at = range.first;
  }
  if (at != data.size()) {
    Throw(label, std::to_string(data.size() - at) + " bytes after the last tensor belong to none");
  }
}

// -------------------------------------------------------------------------------------------------------
// WeightsFile

WeightsFile WeightsFile::Load(const std::string& dir) {
  Manifest manifest = Manifest::Load(dir);
  return Parse(ReadFile(dir + "/weights.safetensors"), std::move(manifest), dir);
}

WeightsFile WeightsFile::Parse(std::vector<uint8_t> safetensors, Manifest manifest,
                               const std::string& label) {
  WeightsFile w;
  w.label_ = label;
  w.manifest_ = std::move(manifest);
  const std::string file_label = label + "/weights.safetensors";
  const SafeTensors file(std::move(safetensors), file_label);
  const std::string found = Sha256Hex(file.file().data(), file.file().size());
  if (const std::string wanted = w.manifest_.Text("/sha256"); found != wanted) {
    Throw(file_label, "sha256 is " + found + ", the manifest says " + Quoted(wanted));
  }
  std::set<std::string, std::less<>> consumed;
  for (const auto& [net, spec] : w.manifest_.networks()) {
    for (const Wanted& want : WantedTensors(net, spec)) {
      const std::string where = "tensor " + Quoted(want.name);
      const auto shape =
          want.cols > 0 ? std::vector<int64_t>{want.rows, want.cols} : std::vector<int64_t>{want.rows};
      const auto it = file.tensors().find(want.name);
      if (it == file.tensors().end()) {
        Throw(label, where + " is missing, the manifest wants " + ShapeText(shape));
      }
      const Tensor& t = it->second;
      if (t.shape != shape) {
        Throw(label, where + " is " + ShapeText(t.shape) + ", the manifest says " + ShapeText(shape));
      }
      consumed.insert(want.name);
      const int cols = std::max(want.cols, 1);
      RowMatrixXf m(want.rows, cols);
      for (int64_t i = 0; i < m.size(); ++i) m.data()[i] = Value(t, i);
      if (t.dtype == Dtype::kI8) {
        const std::string scale_name = want.name + ".scale";
        const int64_t scales = want.cols > 0 ? want.rows : 1;
        const auto scale = file.tensors().find(scale_name);
        if (scale == file.tensors().end())
          Throw(label, where + " is I8 and needs tensor " + Quoted(scale_name));
        if (scale->second.dtype != Dtype::kF32 || scale->second.shape != std::vector<int64_t>{scales}) {
          Throw(label, "tensor " + Quoted(scale_name) + " is " + ShapeText(scale->second.shape) + " " +
                           Name(scale->second.dtype) + ", wanted " + std::to_string(scales) + " F32");
        }
        consumed.insert(scale_name);
        for (int r = 0; r < want.rows; ++r) m.row(r) *= Value(scale->second, want.cols > 0 ? r : 0);
      }
      for (int64_t i = 0; i < m.size(); ++i) {
        if (!std::isfinite(m.data()[i])) {
          Throw(label, where + " holds a value that is not finite, at [" + std::to_string(i / cols) +
                           (want.cols > 0 ? "," + std::to_string(i % cols) : "") + "]");
        }
      }
      w.tensors_.emplace(want.name, std::move(m));
    }
  }
  for (const auto& [name, tensor] : file.tensors()) {
    if (!consumed.contains(name)) {
      Throw(label, "tensor " + Quoted(name) + " (" + ShapeText(tensor.shape) +
                       ") is in the file, but no network of the manifest wants it");
    }
  }
  return w;
}

WeightsFile WeightsFile::Random(const NetworkSpec& spec, unsigned seed) {
  WeightsFile w;
  w.label_ = "random weights";
  w.manifest_ = Manifest::Of("net", spec);
  std::mt19937 rng(seed);
  const float bound = 1.0f / std::sqrt(static_cast<float>(spec.hidden));
  std::uniform_real_distribution<float> value(-bound, bound);
  for (const Wanted& want : WantedTensors("net", spec)) {
    const bool gain = want.name.ends_with("norm.weight");  // of a layer norm: about 1
    w.tensors_.emplace(want.name, RowMatrixXf::NullaryExpr(want.rows, std::max(want.cols, 1), [&] {
                         return (gain ? 1.0f : 0.0f) + value(rng);
                       }));
  }
  return w;
}

}  // namespace intabs
