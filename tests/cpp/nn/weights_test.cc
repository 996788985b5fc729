#include "intabs/nn/weights.h"

#include <catch2/catch.hpp>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <limits>

#include "intabs/nn/network.h"
#include "nn/random_weights.h"
#include "nn/weights_fuzz.h"

using namespace intabs;

namespace {

const NetworkSpec kSpec{.input = 5,
                        .input_linear = 6,
                        .layers = 2,
                        .hidden = 8,
                        .residual = true,
                        .heads = {{"a_mean", 3}, {"b", 1}}};

// The error's text; it must be one line.
template <typename F>
std::string ErrorOf(F&& f) {
  try {
    f();
  } catch (const std::exception& e) {
    const std::string text = e.what();
    CHECK(text.find('\n') == std::string::npos);
    return text;
  }
  return "no error";
}

std::string LoadError(const RawTensors& tensors) {
  return ErrorOf([&] { MakeWeights({{"pi", kSpec}}, tensors); });
}

std::string ImageError(std::vector<uint8_t> image) {
  return ErrorOf([&] { SafeTensors(std::move(image), "f"); });
}

std::string ManifestError(const std::string& text) {
  return ErrorOf([&] { Manifest::Parse(text, "m"); });
}

RawTensors Good() { return RandomNetwork("pi", kSpec, 1); }

void SetFloat(RawTensor& t, size_t i, float v) { std::memcpy(t.bytes.data() + 4 * i, &v, 4); }

}  // namespace

TEST_CASE("SHA-256 gives the digests of FIPS 180-4") {
  const auto hex = [](const std::string& s) {
    return Sha256Hex(reinterpret_cast<const uint8_t*>(s.data()), s.size());
  };
  CHECK(hex("") == "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855");
  CHECK(hex("abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
  CHECK(hex("abcdbcdecdefdefgefghfghighijhijkijkljklmklmnlmnomnopnopq") ==
        "248d6a61d20638b8e5c026930c3e6039a33ce45964ff2167f6ecedd419db06c1");
  CHECK(hex(std::string(1000000, 'a')) == "cdc76e5c9914fb9281a1c7e284d73e67f1809a48a497200e046d39ccc7112cd0");
}

TEST_CASE("A good weights file loads and its tensors hold what was written") {
  RawTensors t = Good();
  SetFloat(t["pi.lstm.1.weight_hh"], 8 * 3 + 2, 0.625f);
  const WeightsFile w = MakeWeights({{"pi", kSpec}}, t);
  CHECK(w.tensor("pi.lstm.1.weight_hh").rows() == 32);
  CHECK(w.tensor("pi.lstm.1.weight_hh")(3, 2) == 0.625f);
  CHECK(w.tensor("pi.heads.b.bias").rows() == 1);
}

TEST_CASE("16-bit and 8-bit tensors become the floats they stand for") {
  RawTensors t = Good();
  // 1.5, -2^-24 (the smallest half), 65504, -0
  t["pi.heads.a_mean.bias"] = {"F16", {3}, {0x00, 0x3e, 0x01, 0x80, 0xff, 0x7b}};
  t["pi.heads.b.bias"] = {"BF16", {1}, {0xc0, 0xbf}};  // -1.5
  t["pi.heads.b.weight"] = {"I8", {1, 8}, {1, 2, 3, 0xff, 0x80, 0x7f, 0, 5}};
  t["pi.heads.b.weight.scale"] = RawTensor{"F32", {1}, {0, 0, 0, 0x3f}};  // 0.5
  const WeightsFile w = MakeWeights({{"pi", kSpec}}, t);
  const RowMatrixXf& half = w.tensor("pi.heads.a_mean.bias");
  CHECK(half(0, 0) == 1.5f);
  CHECK(half(1, 0) == -std::ldexp(1.0f, -24));
  CHECK(half(2, 0) == 65504.0f);
  CHECK(w.tensor("pi.heads.b.bias")(0, 0) == -1.5f);
  const RowMatrixXf& i8 = w.tensor("pi.heads.b.weight");
  CHECK(i8(0, 0) == 0.5f);
  CHECK(i8(0, 3) == -0.5f);
  CHECK(i8(0, 4) == -64.0f);
  CHECK(i8(0, 5) == 63.5f);

  t.erase("pi.heads.b.weight.scale");
  CHECK(LoadError(t) ==
        "weights/t: tensor \"pi.heads.b.weight\" is I8 and needs tensor \"pi.heads.b.weight.scale\"");
}

TEST_CASE("Each fault of a tensor is one line that names tensor, found and expected") {
  RawTensors t = Good();
  t["pi.lstm.1.weight_hh"].shape = {64, 4};
  CHECK(LoadError(t) == "weights/t: tensor \"pi.lstm.1.weight_hh\" is 64x4, the manifest says 32x8");

  t = Good();
  t.erase("pi.lstm.0.bias_ih");
  CHECK(LoadError(t) == "weights/t: tensor \"pi.lstm.0.bias_ih\" is missing, the manifest wants 32");

  t = Good();
  std::mt19937 rng;
  t["pi.extra"] = RandomTensor({2, 3}, 1, rng);
  CHECK(LoadError(t) ==
        "weights/t: tensor \"pi.extra\" (2x3) is in the file, but no network of the manifest wants it");

  t = Good();
  t["pi.input.bias"].dtype = "F64";
  CHECK(LoadError(t) ==
        "weights/t/weights.safetensors: tensor \"pi.input.bias\" has dtype \"F64\", wanted F32, F16, BF16 or "
        "I8");

  for (const float bad : {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity()}) {
    t = Good();
    SetFloat(t["pi.input.weight"], 7, bad);
    CHECK(LoadError(t) == "weights/t: tensor \"pi.input.weight\" holds a value that is not finite, at [1,2]");
  }
}

TEST_CASE("A changed byte is found by the hash") {
  std::vector<uint8_t> image = SafeTensorsImage(Good());
  const std::string sha = Sha256Hex(image.data(), image.size());
  image.back() ^= 1;
  const std::string error = ErrorOf([&] {
    WeightsFile::Parse(image, Manifest::Parse(ManifestText({{"pi", kSpec}}, sha), "m"), "weights/t");
  });
  CHECK(error.starts_with("weights/t/weights.safetensors: sha256 is "));
  CHECK(error.ends_with(", the manifest says \"" + sha + "\""));
}

TEST_CASE("A file cut anywhere is refused with one line") {
  const std::vector<uint8_t> image = SafeTensorsImage(Good());
  CHECK(ImageError({}) == "f: is cut: 0 bytes, a safetensors file has at least 8");
  for (size_t n = 0; n < image.size(); n += 1 + n / 7) {
    CAPTURE(n);
    CHECK(ImageError({image.begin(), image.begin() + static_cast<ptrdiff_t>(n)}).starts_with("f: is cut: "));
  }
}

TEST_CASE("A header that lies is refused") {
  const auto with = [](const std::string& entries) {
    return WithHeader("{" + entries + "}", std::vector<uint8_t>(16));
  };
  const std::string a = R"("a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]})";
  const std::string b = R"("b":{"dtype":"F32","shape":[2],"data_offsets":[8,16]})";
  CHECK(ImageError(with(a + "," + b)) == "no error");
  CHECK(ImageError(with(a)) == "f: 8 bytes after the last tensor belong to none");
  CHECK(ImageError(with(b)) == "f: tensor \"b\" begins at byte 8 of the data, wanted 0");
  CHECK(ImageError(with(a + "," + a)) == "f: header: names \"a\" twice");
  CHECK(ImageError(with(R"("a":{"dtype":"F32","shape":[3],"data_offsets":[0,8]})")) ==
        "f: tensor \"a\" takes 8 bytes, its shape 3 F32 needs 12");
  CHECK(
      ImageError(with(R"("a":{"dtype":"F32","shape":[1099511627776,1099511627776],"data_offsets":[0,8]})")) ==
      "f: tensor \"a\": shape is empty or too large");
  CHECK(ImageError(with(R"("a":{"dtype":"F32","shape":[-2],"data_offsets":[0,8]})")) ==
        "f: tensor \"a\": shape and data_offsets must be whole numbers");
  CHECK(ImageError(with(R"("a":{"dtype":"F32","shape":[2],"data_offsets":[8,0]})"))
            .starts_with("f: tensor \"a\" takes"));
  CHECK(ImageError(with(R"("a":5)")) == "f: tensor \"a\": the header lacks dtype, shape or data_offsets");
  CHECK(ImageError(WithHeader("[1,2]", {})) == "f: header: is not a JSON object");
  CHECK(ImageError(WithHeader("{\"a\"", {})) == "f: header: is not valid JSON");
}

TEST_CASE("Each fault of a manifest is one line") {
  const auto with = [](const std::string& net) {
    return "{\"schema_version\":1,\"networks\":{\"pi\":" + net + "}}";
  };
  CHECK(ManifestError("{") == "m: is not valid JSON");
  CHECK(ManifestError("{}") == "m: has no \"/schema_version\"");
  CHECK(ManifestError("{\"schema_version\":2}") == "m: schema_version is 2, this program reads 1");
  CHECK(ManifestError("{\"schema_version\":1}") == "m: has no \"/networks\"");
  CHECK(ManifestError(with("{}")) == "m: network \"pi\": \"input\" is missing");
  CHECK(ManifestError(with(R"({"input":0,"layers":1,"hidden":1,"heads":{}})")) ==
        "m: network \"pi\": \"input\" must be a whole number from 1 to 65536");
  CHECK(ManifestError(with(R"({"input":1,"layers":1,"hidden":99999999999999999999,"heads":{}})")) ==
        "m: network \"pi\": \"hidden\" must be a whole number from 1 to 16384");
  CHECK(ManifestError(with(R"({"input":1,"layers":1,"hidden":8,"heads":{"a":0}})")) ==
        "m: network \"pi\": the size of head \"a\" must be a whole number from 1 to 65536");
  CHECK(ManifestError(with(R"({"input":1,"layers":1,"hidden":8,"heads":{},"residuals":true})")) ==
        "m: network \"pi\": unknown key \"residuals\"");
  CHECK(ErrorOf([] { MakeRandomWeights(kSpec, 1).manifest().network("eta"); }) ==
        "weights/t/manifest.json: has no network \"eta\"; it has net");
}

TEST_CASE("Other rooms read their own entries of the manifest") {
  const Manifest m =
      Manifest::Parse(ManifestText({{"pi", kSpec}}, "x",
                                   R"("rate_hz":25,"norm":{"mean":[[1,2],[3,4.5]],"names":["a","b"]},)"),
                      "m");
  CHECK(m.Integer("/rate_hz") == 25);
  CHECK(m.Numbers("/norm/mean") == std::vector<double>{1, 2, 3, 4.5});
  CHECK(m.Texts("/norm/names") == std::vector<std::string>{"a", "b"});
  CHECK(m.Keys("/norm") == std::vector<std::string>{"mean", "names"});
  CHECK_FALSE(m.Has("/norm/std"));
  CHECK(ErrorOf([&] { m.Numbers("/norm/std"); }) == "m: has no \"/norm/std\"");
  CHECK(ErrorOf([&] { m.Numbers("/norm/names"); }) ==
        "m: \"/norm/names\" holds something that is not a finite number");
}

TEST_CASE("A folder loads from disk, and missing or cut files are one clear line") {
  namespace fs = std::filesystem;
  const fs::path dir =
      fs::temp_directory_path() / ("intabs_weights_test_" + std::to_string(std::random_device{}()));
  const std::string d = dir.string();
  const auto error = [&] { return ErrorOf([&] { Network::Load(d, "pi"); }); };
  CHECK(error() == d + "/manifest.json: cannot be opened (No such file or directory)");
  fs::create_directory(dir);
  const std::vector<uint8_t> image = SafeTensorsImage(Good());
  std::ofstream(dir / "manifest.json")
      << ManifestText({{"pi", kSpec}}, Sha256Hex(image.data(), image.size()));
  CHECK(error() == d + "/weights.safetensors: cannot be opened (No such file or directory)");
  const auto write = [&](size_t n) {
    std::ofstream(dir / "weights.safetensors", std::ios::binary)
        .write(reinterpret_cast<const char*>(image.data()), static_cast<std::streamsize>(n));
  };
  write(image.size() - 10);
  CHECK(error().starts_with(d + "/weights.safetensors: is cut: tensor \"pi."));
  write(image.size());
  CHECK(error() == "no error");
  fs::remove_all(dir);
}

TEST_CASE("Damaged weights are refused with one line or load, and nothing worse") {
  // The fuzz target's seeds, then each with bytes changed, cut out or doubled.
  std::mt19937 rng(1);
  int seeds = 0, refused = 0;
  for (const auto& entry :
       std::filesystem::directory_iterator(INTABS_SOURCE_DIR "/tests/cpp/nn/fuzz_corpus")) {
    std::ifstream in(entry.path(), std::ios::binary);
    const std::string seed((std::istreambuf_iterator<char>(in)), {});
    const auto load = [](const std::string& s) {
      return LoadFromBytes(reinterpret_cast<const uint8_t*>(s.data()), s.size());
    };
    INFO(entry.path());
    REQUIRE(load(seed) == "");
    ++seeds;
    for (int i = 0; i < 500; ++i) {
      std::string damaged = seed;
      for (int changes = 1 + static_cast<int>(rng() % 3); changes > 0; --changes) {
        const size_t at = rng() % damaged.size(), n = 1 + rng() % 8;
        switch (rng() % 4) {
          case 0:
            damaged[at] = static_cast<char>(rng());
            break;
          case 1:
            damaged[at] = "0123456789-{}[]\",:.eE"[rng() % 21];
            break;
          case 2:
            damaged.erase(at, n);
            break;
          default:
            damaged.insert(at, damaged.substr(at, n));
            break;
        }
        if (damaged.empty()) damaged = "{";
      }
      refused += load(damaged) != "";
    }
  }
  CHECK(seeds >= 6);
  CHECK(refused > 300 * seeds);
}
