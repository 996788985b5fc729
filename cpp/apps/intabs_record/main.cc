// intabs_record: everything LCM carries into a file of lcm-logger's format; with --mirror the puppet follows the
// master.
#include <CLI/CLI.hpp>
#include <algorithm>
#include <cctype>
#include <cstdio>
#include <exception>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <map>
#include <nlohmann/json.hpp>
#include <random>

#include "../common/yaml_config.h"
#include "intabs/bus/lcm_bus.h"
#include "intabs/bus/lcm_log.h"
#include "intabs/rt/periodic.h"
#include "intabs/rt/stop_signal.h"
#include "mirror.h"

namespace intabs {
namespace {

constexpr int64_t kFlushUs = 1'000'000;

struct Options {
  std::string out;
  bool force = false;
  std::string lcm = kDefaultLcmUrl;
  bool mirror = false;
  std::string master = "MASTER_";
  std::string prefix;
  std::string clock = "wall";
  std::string json;
};

int64_t RandomSession() {
  std::random_device device;
  return static_cast<int64_t>((uint64_t{device()} << 32 | device()) >> 1 | 1);
}

std::string IsPrefix(const std::string& s) {
  const bool plain =
      std::all_of(s.begin(), s.end(), [](unsigned char c) { return std::isalnum(c) || c == '_'; });
  return plain ? "" : "\"" + s + "\": only letters, digits and underscores, like MASTER_";
}

class Recorder {
 public:
  explicit Recorder(const Options& o)
      : options_(o), bus_(o.lcm), log_(o.out), mirror_(o.clock == "lockstep", RandomSession()) {
    bus_.SubscribeAll([this](int64_t utime, const std::string& channel, const uint8_t* data, size_t size) {
      try {
        log_.Write(utime, channel, data, size);
        ++events_[channel];
      } catch (...) {  // not through LCM's C
        failure_ = std::current_exception();
      }
    });
    if (!o.mirror) return;
    bus_.Subscribe(Channel<ArmStatus>{o.master + kLite6Status.name},
                   [this](const ArmStatus& m) { mirror_.OnMaster(m, MonotonicUs()); });
    bus_.Subscribe(Channel<ArmStatus>{o.prefix + kLite6Status.name}, [this](const ArmStatus& s) {
      mirror_.OnPuppet(s, MonotonicUs());
    });
  }

  void Run() {
    const Channel<ArmCommand> to_puppet{options_.prefix + kLite6Command.name};
    const int64_t begin_us = MonotonicUs();
    int64_t flushed_us = begin_us;
    bool was_silent = false;
    while (!StopRequested()) {
      if (bus_.Handle(100) < 0) throw std::runtime_error("LCM is broken on " + options_.lcm);
      if (failure_) std::rethrow_exception(failure_);
      const int64_t now_us = MonotonicUs();
      ArmCommand command;
      while (options_.mirror && mirror_.Answer(now_us, command)) bus_.Publish(to_puppet, command);
      if (mirror_.silent() != was_silent) {
        was_silent = mirror_.silent();
        std::fprintf(stderr, was_silent ? "intabs_record: the master is silent: the puppet holds\n"
                                        : "intabs_record: the master speaks again: the puppet follows\n");
      }
      if (now_us - flushed_us >= kFlushUs) {
        log_.Flush();
        flushed_us = now_us;
      }
    }
    while (bus_.Handle(0) > 0) {
    }  // what has arrived belongs to the recording
    log_.Flush();
    seconds_ = static_cast<double>(MonotonicUs() - begin_us) * 1e-6;
  }

  void Report() const {
    int64_t n = 0;
    for (const auto& [channel, count] : events_) n += count;
    std::printf("%s: %ld messages on %zu channels in %.1f s\n", options_.out.c_str(), static_cast<long>(n),
                events_.size(), seconds_);
    if (options_.json.empty()) return;
    nlohmann::json figures = {{"record", {{"messages", n}, {"seconds", seconds_}, {"channels", events_}}}};
    if (options_.mirror) figures["mirror"] = {{"answered", mirror_.answered()}, {"held", mirror_.held()}};
    std::ofstream out(options_.json);
    out << figures.dump(2) << "\n";
    if (!out) throw std::runtime_error("cannot write " + options_.json);
  }

 private:
  const Options options_;
  LcmBus bus_;
  LcmLogWriter log_;
  Mirror mirror_;
  std::map<std::string, int64_t> events_;  // by channel
  std::exception_ptr failure_;             // of writing
  double seconds_ = 0;
};

int Main(int argc, char** argv) {
  Options o;
  CLI::App app{
      "Records every LCM channel into a file of lcm-logger's format, until SIGINT. With --mirror the puppet\n"
      "arm follows the master arm: MASTER_LITE6_STATUS in, LITE6_COMMAND out."};
  AddYamlConfig(app);
  app.add_option("--out", o.out, "file to write")->required();
  app.add_flag("--force", o.force, "overwrite it if it is there");
  app.add_option("--lcm", o.lcm, "LCM URL")->capture_default_str();
  app.add_flag("--mirror", o.mirror, "the puppet follows the master; a silent master makes it hold");
  app.add_option("--master", o.master, "comes before the names of the master's channels")
      ->check(CLI::Validator(IsPrefix, "PREFIX"))
      ->capture_default_str();
  app.add_option("--prefix", o.prefix, "comes before the names of the puppet's channels")
      ->check(CLI::Validator(IsPrefix, "PREFIX"));
  app.add_option("--clock", o.clock, "wall: real arms; lockstep: as the plant, with a master on its time")
      ->check(CLI::IsMember({"lockstep", "wall"}))
      ->capture_default_str();
  app.add_option("--json", o.json, "write the figures there at the end");
  try {
    app.parse(argc, argv);
    if (o.mirror && o.master == o.prefix) {
      throw CLI::ValidationError("--master and --prefix name the same arm: it cannot follow itself");
    }
    if (!o.force && std::filesystem::exists(o.out)) {
      throw CLI::ValidationError(o.out + " is there already: give another --out, or --force");
    }
  } catch (const CLI::ParseError& e) {
    if (e.get_exit_code() == 0) return app.exit(e);
    const auto config = std::static_pointer_cast<YamlConfig>(app.get_config_formatter());
    std::cerr << "intabs_record: " << config->Describe(e, argc, argv) << " (see --help)\n";
    return 1;
  }
  InstallStopSignals();
  try {
    Recorder recorder(o);
    recorder.Run();
    recorder.Report();
  } catch (const std::exception& e) {
    std::cerr << "intabs_record: " << e.what() << "\n";
    return 1;
  }
  return 0;
}

}  // namespace
}  // namespace intabs

int main(int argc, char** argv) { return intabs::Main(argc, argv); }
