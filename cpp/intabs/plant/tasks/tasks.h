#pragma once

#include <memory>

#include "intabs/plant/task.h"

namespace intabs {

inline constexpr double kDegree = M_PI / 180;
inline constexpr Disc kGroundTag = {0.52, 0, 0.085};
inline constexpr double kUpright = 0.95;  // cosine: 18 degrees

std::unique_ptr<Task> MakePickPlace();
std::unique_ptr<Task> MakeDrawerOpen();
std::unique_ptr<Task> MakeBoxOpen();
std::unique_ptr<Task> MakePour();
std::unique_ptr<Task> MakeStir();

}  // namespace intabs
