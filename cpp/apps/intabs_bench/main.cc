// intabs_bench SUITE [--json F]: how long the inner parts take on this machine.
#include <CLI/CLI.hpp>
#include <cstdio>
#include <exception>

#include "suite.h"

namespace {

struct Suite {
  const char* name;
  intabs::bench::Report (*run)(const intabs::bench::Options&);
  const char* what;
};
constexpr Suite kSuites[] = {
    {"lstm", &intabs::bench::Lstm,
     "one policy tick in each weight format and instruction set, a batch, the memory limit"},
    {"encoder", &intabs::bench::Encoder, "a bidirectional network over 100 steps, one thread and two"},
    {"tags", &intabs::bench::Tags, "1280 x 720 with five tags on the move, beside AprilTag on whole frames"},
    {"filter", &intabs::bench::Filter, "a tick of the command filter, collision look-ahead included"},
    {"loop", &intabs::bench::Loop, "how late a 250 Hz loop wakes up, beside cyclictest if that is installed"},
    {"plant", &intabs::bench::Plant, "a driver tick of each task's world, the arm swinging, without pictures"},
};

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("Benchmarks. Compare ratios within one run, not times between runs.");
  std::string name, json;
  intabs::bench::Options options;
  std::string known;
  std::vector<std::string> names;
  for (const Suite& s : kSuites) {
    names.emplace_back(s.name);
    known += std::string("\n  ") + s.name + ": " + s.what;
  }
  app.add_option("suite", name, "One of:" + known)->required()->check(CLI::IsMember(names));
  app.add_option("--json", json, "Write the figures to this file");
  app.add_option("--rounds", options.rounds, "Rounds, each of which measures every row")
      ->check(CLI::Range(1, 100));
  app.add_option("--samples", options.samples, "Samples of a quick row in a round")
      ->check(CLI::Range(20, 1000000));
  app.add_option("--models", options.models, "plant: folder with scenes, objects and the arm")->capture_default_str();
  app.add_option("--soak", options.soak, "lstm: also a run of so many steps for the tail, pinned")
      ->check(CLI::Range(0L, 100000000L));
  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& e) {
    if (e.get_exit_code() == 0) return app.exit(e);  // --help
    std::fprintf(stderr, "intabs_bench: %s (see --help)\n", e.what());
    return 1;
  }
  try {
    for (const Suite& s : kSuites) {
      if (name != s.name) continue;
      const intabs::bench::Report report = s.run(options);
      intabs::bench::Print(report);
      if (!json.empty()) intabs::bench::WriteJson(report, name, json);
    }
  } catch (const std::exception& e) {
    std::fprintf(stderr, "intabs_bench: %s\n", e.what());
    return 1;
  }
}
