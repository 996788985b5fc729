// libFuzzer target: the manifest of weights, and everything that is asked of it.
#include <cmath>
#include <cstdlib>
#include <exception>
#include <string>

#include "intabs/nn/weights.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using intabs::Manifest;
  const auto refused_in_one_line = [](const auto& ask) {
    try {
      ask();
    } catch (const std::exception& e) {
      const std::string text = e.what();
      if (text.empty() || text.find('\n') != std::string::npos) std::abort();
    }
  };
  refused_in_one_line([&] {
    const Manifest m = Manifest::Parse({reinterpret_cast<const char*>(data), size}, "manifest.json");
    for (const auto& network : m.networks()) {
      const auto& spec = network.second;
      if (spec.input < 1 || spec.layers < 1 || spec.hidden < 1) std::abort();
      refused_in_one_line([&] { (void)m.Keys("/networks/" + network.first); });
    }
    for (const char* path : {"/normalizer/state_mean", "/normalizer/agent_action_scale", "/plans", "/networks", ""}) {
      refused_in_one_line([&] {
        for (const double v : m.Numbers(path)) {
          if (!std::isfinite(v)) std::abort();
        }
      });
      refused_in_one_line([&] { (void)m.Texts(path); });
      refused_in_one_line([&] { (void)m.Keys(path); });
    }
    refused_in_one_line([&] { (void)m.Text("/state_layout"); });
    refused_in_one_line([&] { (void)m.Integer("/policy_period_us"); });
    refused_in_one_line([&] { (void)m.Bool("/policy_period_us"); });
    refused_in_one_line([&] {
      if (!std::isfinite(m.Number("/normalizer/limit"))) std::abort();
    });
  });
  return 0;
}
