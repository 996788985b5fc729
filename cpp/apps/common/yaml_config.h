// Command lines with `--config FILE.yaml`: a flat map, one key an option's long name. The command line wins.
// Unknown keys are errors; every error is one line and names file and key.
#pragma once

#include <yaml-cpp/yaml.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <iostream>
#include <memory>
#include <optional>
#include <sstream>
#include <string>
#include <vector>

#include "intabs/core/text.h"

namespace intabs {

class YamlConfig : public CLI::Config {
 public:
  // passed_over: keys of the file that are no options but for somebody else.
  YamlConfig(const CLI::App& app, std::vector<std::string> passed_over)
      : app_(app), passed_over_(std::move(passed_over)) {}

  std::string to_config(const CLI::App*, bool, bool, std::string) const override { return ""; }

  std::vector<CLI::ConfigItem> from_config(std::istream& in) const override {
    std::stringstream text;
    text << in.rdbuf();
    YAML::Node root;
    try {
      root = YAML::Load(text.str());
    } catch (const YAML::Exception& e) {
      throw CLI::FileError(File() + ": not readable as YAML: line " + std::to_string(e.mark.line + 1) + ": " +
                           e.msg);
    }
    if (root.IsNull()) return {};
    if (!root.IsMap()) throw CLI::FileError(File() + ": expected a map of option: value");
    std::vector<CLI::ConfigItem> items;
    for (const auto& entry : root) {
      CLI::ConfigItem item;
      item.name = entry.first.IsScalar() ? entry.first.Scalar() : "?";
      if (std::find(passed_over_.begin(), passed_over_.end(), item.name) != passed_over_.end()) continue;
      const std::string at = File() + ": key \"" + item.name + "\"";
      if (item.name == "config" || app_.get_option_no_throw("--" + item.name) == nullptr)
        throw CLI::FileError(at + " is unknown");
      if (entry.second.IsScalar()) {
        item.inputs = {entry.second.Scalar()};
      } else if (entry.second.IsSequence()) {
        for (const auto& value : entry.second) {
          if (!value.IsScalar()) throw CLI::FileError(at + ": expected a list of values");
          item.inputs.push_back(value.Scalar());
        }
      } else {
        throw CLI::FileError(at + ": expected a value");
      }
      keys_.push_back(item.name);
      items.push_back(item);
    }
    return items;
  }

  // What CLI11 says, with the file before it where the faulty value came from there.
  std::string Describe(const CLI::ParseError& e, int argc, char** argv) const {
    const std::string what = e.what();
    for (const std::string& key : keys_) {
      const std::string option = "--" + key;
      const size_t at = what.find(option);
      if (at == std::string::npos) continue;
      const char after = what.c_str()[at + option.size()];
      if (std::isalnum(static_cast<unsigned char>(after)) || after == '-' || after == '_') continue;
      const bool given = std::any_of(argv + 1, argv + argc, [&](const std::string& a) {
        return a == option || a.starts_with(option + "=");
      });
      if (!given) return OneLine(File() + ": key \"" + key + "\": " + what);
    }
    return OneLine(what);
  }

 private:
  std::string File() const { return app_.get_config_ptr()->as<std::string>(); }

  const CLI::App& app_;
  const std::vector<std::string> passed_over_;
  mutable std::vector<std::string> keys_;  // CLI11 reads through a const reference
};

inline void AddYamlConfig(CLI::App& app, const std::string& file = "",
                          std::vector<std::string> passed_over = {},
                          const std::string& what = "YAML file with these options") {
  auto* option = app.set_config("--config", file, what, false);
  if (!file.empty()) option->capture_default_str();
  app.config_formatter(std::make_shared<YamlConfig>(app, std::move(passed_over)));
  app.allow_config_extras(CLI::config_extras_mode::error);
}

// Parses, after AddYamlConfig. An exit code where the program is to end now: --help was asked for, or the
// input is bad, which has been said on stderr.
inline std::optional<int> ParseCommandLine(CLI::App& app, const std::string& program, int argc, char** argv) {
  try {
    app.parse(argc, argv);
    return std::nullopt;
  } catch (const CLI::ParseError& e) {
    if (e.get_exit_code() == 0) return app.exit(e);
    const auto config = std::static_pointer_cast<YamlConfig>(app.get_config_formatter());
    std::cerr << program << ": " << config->Describe(e, argc, argv) << " (see --help)\n";
    return 1;
  }
}

}  // namespace intabs
