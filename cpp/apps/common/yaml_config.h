// `--config FILE.yaml`: a flat map, one key an option's long name. The command line wins. Unknown keys are errors.
#pragma once

#include <yaml-cpp/yaml.h>

#include <CLI/CLI.hpp>
#include <memory>
#include <sstream>
#include <string>
#include <vector>

namespace intabs {

class YamlConfig : public CLI::Config {
 public:
  std::string to_config(const CLI::App*, bool, bool, std::string) const override { return ""; }
  std::vector<CLI::ConfigItem> from_config(std::istream& in) const override {
    std::stringstream text;
    text << in.rdbuf();
    YAML::Node root;
    try {
      root = YAML::Load(text.str());
      if (root.IsNull()) return {};
      if (!root.IsMap()) throw CLI::FileError("--config: the file must be a map of option: value");
      std::vector<CLI::ConfigItem> items;
      for (const auto& entry : root) {
        CLI::ConfigItem item;
        item.name = entry.first.as<std::string>();
        item.inputs = {entry.second.as<std::string>()};
        items.push_back(item);
      }
      return items;
    } catch (const YAML::Exception& e) {
      throw CLI::FileError(std::string("--config: ") + e.what());
    }
  }
};

inline void AddYamlConfig(CLI::App& app) {
  app.set_config("--config", "", "YAML file with these options")->check(CLI::ExistingFile);
  app.config_formatter(std::make_shared<YamlConfig>());
  app.allow_config_extras(CLI::config_extras_mode::error);
}

}  // namespace intabs
