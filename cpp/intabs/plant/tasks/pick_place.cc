// pick_place: take the block by its handle, stand it on the goal.
#include "intabs/plant/tasks/tasks.h"

namespace intabs {
namespace {

constexpr double kReach = 0.02;  // [m] from the goal
constexpr double kHalf = 0.022;  // of the cube [m]

class PickPlace final : public Task {
 public:
  std::vector<TaskObject> objects() const override {
    return {{.body = "block", .slot = 0, .id = 0, .azimuth = -15 * kDegree, .radius = 0.28, .height = kHalf},
            {.body = "goal", .slot = 1, .id = 1, .azimuth = 15 * kDegree, .radius = 0.30}};
  }
  std::vector<std::string> subgoals() const override { return {"grasped", "lifted", "placed"}; }

  uint32_t Subgoals(const TaskView& v) const override {
    const bool grasped = v.gripper_closed && v.FingersTouch("block");
    const bool lifted = grasped && v.Body("block").p.z() > kHalf + 0.02;
    return uint32_t{grasped} | uint32_t{lifted} << 1 | uint32_t{Missing(v).empty()} << 2;
  }

  std::string Missing(const TaskView& v) const override {
    const Pose block = v.Body("block");
    const double distance = (block.p - v.Body("goal").p).head<2>().norm();
    if (v.gripper_closed || v.FingersTouch("block")) return "block not released";
    if (v.Upright("block") < kUpright) return "block fell over";
    if (std::abs(block.p.z() - kHalf) > 0.005) return "block does not stand on the table";
    if (v.LinearSpeed("block") > 0.01 || v.AngularSpeed("block") > 0.1) return "block not at rest";
    if (distance > kReach) return "block over 2 cm from the goal";
    return "";
  }
};

}  // namespace

std::unique_ptr<Task> MakePickPlace() { return std::make_unique<PickPlace>(); }

}  // namespace intabs
