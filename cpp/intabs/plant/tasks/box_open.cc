// box_open: push the lid of the box up by its tab, so far that it stays open.
#include "intabs/plant/tasks/tasks.h"

namespace intabs {
namespace {

constexpr double kOpen = 60 * kDegree;
constexpr double kStill = 0.05;  // [rad/s]

class BoxOpen final : public Task {
 public:
  std::vector<TaskObject> objects() const override {
    return {{.body = "lid",
             .slot = 3,
             .id = 3,
             .azimuth = 45 * kDegree,
             .radius = 0.43,
             .base = "box",
             .footprint = {{0, 0, 0.07}, {-0.09, 0, 0.045}}}};
  }
  std::vector<std::string> subgoals() const override { return {"tab touched", "lid raised", "lid open"}; }

  uint32_t Subgoals(const TaskView& v) const override {
    return uint32_t{v.FingersTouch("lid")} | uint32_t{v.Joint("lid") > 0.5 * kOpen} << 1 |
           uint32_t{Missing(v).empty()} << 2;
  }

  std::string Missing(const TaskView& v) const override {
    if (v.Joint("lid") < kOpen) return "lid open less than 60 degrees";
    if (v.FingersTouch("lid")) return "lid not released";
    if (std::abs(v.JointSpeed("lid")) > kStill) return "lid not at rest";
    return "";
  }
};

}  // namespace

std::unique_ptr<Task> MakeBoxOpen() { return std::make_unique<BoxOpen>(); }

}  // namespace intabs
