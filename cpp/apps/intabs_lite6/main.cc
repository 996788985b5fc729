// intabs_lite6: a UFACTORY Lite 6 behind the channels of the arm.
#include <CLI/CLI.hpp>
#include <iostream>
#include <string>

#include "../common/yaml_config.h"
#include "intabs/rt/stop_signal.h"
#include "process.h"

namespace intabs {
namespace {

int Main(int argc, char** argv) {
  Lite6Options o;
  CLI::App app{
      "The arm: LITE6_COMMAND in, LITE6_STATUS out at 250 Hz, command filter and safety states in between. The same "
      "channels as intabs_plant."};
  AddYamlConfig(app);
  app.add_option("--host", o.host, "the controller's address")->required();
  app.add_option("--port", o.port, "its control port")->check(CLI::Range(1, 65535))->capture_default_str();
  app.add_option("--report-port", o.report_port,
                 "its report port: 30000 (250 Hz, firmware 2.1.0 and later) or 30003 (100 Hz); 0: asks after every target")
      ->check(CLI::Range(0, 65535))
      ->capture_default_str();
  app.add_flag("--teach", o.teach, "the arm is guided by hand (vendor's mode 2) and only says where it is");
  app.add_option("--kinematics", o.kinematics, "URDF of this very arm, calibrated; default: the nominal Lite 6")
      ->check(CLI::ExistingFile);
  app.add_flag("--require-realtime", o.require_realtime, "refuse to run without real-time scheduling and locked memory");
  app.add_option("--cpu", o.cpu, "pin the loop to this CPU")->check(CLI::Range(0, 1023));
  app.add_option("--flight", o.flight, "folder for the last 10 s before a fault, every tick, as CSV")
      ->capture_default_str();
  app.add_option("--lcm", o.lcm, "LCM URL")->capture_default_str();
  app.add_option("--prefix", o.prefix, "comes before every channel's name, like MASTER_");
  app.add_option("--json", o.json, "write the figures there at the end");
  if (const auto code = ParseCommandLine(app, "intabs_lite6", argc, argv)) return *code;
  InstallStopSignals();
  try {
    Lite6Process process(o);
    process.Run();
  } catch (const std::exception& e) {
    std::cerr << "intabs_lite6: " << e.what() << "\n";
    return 1;
  }
  return 0;
}

}  // namespace
}  // namespace intabs

int main(int argc, char** argv) { return intabs::Main(argc, argv); }
