// One input for the loader, as bytes: a manifest, a line "---", a safetensors image. Where the manifest's
// sha256 is 64 times '0', it is replaced by the image's, or nothing past the hash would ever be reached.
// Seeds: fuzz_corpus.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "intabs/nn/network.h"
#include "intabs/nn/sha256.h"

namespace intabs {

// Loads, and if that works takes one step of each network. Returns what the loader said, "" if it took the
// input. Anything but a std::exception with one line of text is a fault and aborts.
inline std::string LoadFromBytes(const uint8_t* data, size_t size) {
  const std::string all(reinterpret_cast<const char*>(data), size);
  const size_t cut = all.find("\n---\n");
  std::string manifest = all.substr(0, cut);
  std::vector<uint8_t> image;
  if (cut != std::string::npos) image.assign(data + cut + 5, data + size);
  if (const size_t zeros = manifest.find(std::string(64, '0')); zeros != std::string::npos) {
    manifest.replace(zeros, 64, Sha256Hex(image.data(), image.size()));
  }
  try {
    const WeightsFile file = WeightsFile::Parse(std::move(image), Manifest::Parse(manifest, "m"), "w");
    for (const auto& [name, spec] : file.manifest().networks()) {
      Network net(file, name, {.isa = Isa::kGeneric});
      std::vector<float> x(spec.input, 0.5f);
      const Status status = net.Step(x.data());
      if ((status == Status::kOk) == spec.bidirectional) std::abort();
    }
  } catch (const std::exception& e) {
    const std::string text = e.what();
    if (text.empty() || text.find('\n') != std::string::npos) std::abort();
    return text;
  }
  return "";
}

}  // namespace intabs
