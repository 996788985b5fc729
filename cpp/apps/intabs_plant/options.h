#pragma once

#include <cstdint>
#include <string>

#include "intabs/bus/lcm_bus.h"

namespace intabs {

struct PlantOptions {
  std::string models = "models";
  std::string task = "pick_place";
  int64_t seed = 0;
  double spread = 0;  // [cm]
  std::string clock = "lockstep";
  std::string lcm = kDefaultLcmUrl;
  std::string prefix;
  bool cameras = true;
  std::string ring = "/intabs_frames";
  std::string video;  // empty: none
  std::string strip;  // empty: none
  bool viewer = false;
  std::string json;  // empty: none
};

}  // namespace intabs
