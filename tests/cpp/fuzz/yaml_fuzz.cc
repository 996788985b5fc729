// libFuzzer target: one text as each kind of YAML file that the programs read. What they do not take they must refuse in
// one line, "FILE: what". The file is called in.yaml: a seed that names itself as its calibration is among the corpus.
#include <unistd.h>

#include <cstdio>
#include <cstdlib>
#include <exception>
#include <fstream>
#include <string>

#include "../../../cpp/apps/common/hand_eye.h"
#include "../../../cpp/apps/common/yaml_config.h"
#include "intabs/perception/config.h"

namespace {

struct Folder {
  char path[32] = "/tmp/intabs_fuzz_XXXXXX";
  Folder() {
    if (mkdtemp(path) == nullptr || chdir(path) != 0) std::abort();
  }
  ~Folder() {
    std::remove("in.yaml");
    rmdir(path);
  }
};

template <class F>
void Read(const F& read) {
  try {
    read();
  } catch (const std::exception& e) {
    const std::string text = e.what();
    if (text.find('\n') != std::string::npos || text.find(": ") == std::string::npos) {
      std::fprintf(stderr, "said: %s\n", text.c_str());
      std::abort();
    }
  }
}

// Like intabs_plant: a text, a number, a choice and a flag.
void ParseOptions() {
  CLI::App app;
  std::string task, clock;
  double spread = 0;
  int64_t seed = 0;
  bool cameras = true;
  intabs::AddYamlConfig(app, "in.yaml", {intabs::kConfigKeys.begin(), intabs::kConfigKeys.end()});
  app.add_option("--task", task);
  app.add_option("--seed", seed);
  app.add_option("--spread", spread)->check(CLI::Range(0.0, 15.0));
  app.add_option("--clock", clock)->check(CLI::IsMember({"lockstep", "wall"}));
  app.add_flag("--cameras,!--no-cameras", cameras);
  char name[] = "fuzz";
  char* argv[] = {name};
  try {
    app.parse(1, argv);
  } catch (const CLI::ParseError& e) {
    const auto config = std::static_pointer_cast<intabs::YamlConfig>(app.get_config_formatter());
    throw std::runtime_error(config->Describe(e, 1, argv));
  }
  if (!(spread >= 0 && spread <= 15)) std::abort();
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  static const Folder folder;
  std::ofstream("in.yaml", std::ios::binary).write(reinterpret_cast<const char*>(data), static_cast<long>(size));
  Read([] { (void)intabs::LoadPerceptionConfig("in.yaml"); });
  Read([] { (void)intabs::LoadCalibration("in.yaml"); });
  Read([] { (void)intabs::LoadHandEye("in.yaml"); });
  Read([] { ParseOptions(); });
  return 0;
}
