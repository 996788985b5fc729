#pragma once

#include "intabs/plant/task.h"

namespace intabs {

const Task& PickPlaceTask();

}  // namespace intabs
