// Reads a YAML file for those who link yaml-cpp.
#pragma once

#include <yaml-cpp/yaml.h>

#include <filesystem>
#include <stdexcept>
#include <string>
#include <system_error>

#include "intabs/core/text.h"

namespace intabs {

// Throws std::runtime_error, one line: "FILE: what".
inline YAML::Node LoadYaml(const std::string& file) {
  const auto fail = [&](const std::string& what) { return std::runtime_error(OneLine(file + ": " + what)); };
  // yaml-cpp leaks its buffer when it is given a folder.
  if (std::error_code none; std::filesystem::is_directory(file, none)) throw fail("is a folder");
  try {
    return YAML::LoadFile(file);
  } catch (const YAML::BadFile&) {
    throw fail("cannot be read");
  } catch (const YAML::Exception& e) {
    throw fail("not readable as YAML: line " + std::to_string(e.mark.line + 1) + ": " + e.msg);
  }
}

}  // namespace intabs
