// drawer_open: pull the drawer out of its cabinet by the bar.
#include "intabs/plant/tasks/tasks.h"

namespace intabs {
namespace {

constexpr double kPulled = 0.08;  // [m]

class DrawerOpen final : public Task {
 public:
  std::vector<TaskObject> objects() const override {
    return {{.body = "drawer",
             .slot = 3,
             .id = 2,
             .azimuth = -45 * kDegree,
             .radius = 0.40,
             .base = "cabinet",
             // The cabinet, its tags, and where the drawer comes out.
             .footprint = {{0.03, 0, 0.06}, {0.10, 0, 0.06}, {0, 0.08, 0.03}, {-0.06, 0, 0.05}, {-0.14, 0, 0.05}}}};
  }
  std::vector<std::string> subgoals() const override { return {"bar grasped", "drawer open"}; }

  uint32_t Subgoals(const TaskView& v) const override {
    const bool grasped = v.gripper_closed && v.FingersTouch("drawer");
    return uint32_t{grasped} | uint32_t{Missing(v).empty()} << 1;
  }

  std::string Missing(const TaskView& v) const override {
    return v.Joint("drawer") < kPulled ? "drawer pulled out under 8 cm" : "";
  }
};

}  // namespace

std::unique_ptr<Task> MakeDrawerOpen() { return std::make_unique<DrawerOpen>(); }

}  // namespace intabs
