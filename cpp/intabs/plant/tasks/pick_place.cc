// pick_place: take the block by its handle, stand it on the goal.
#include "intabs/plant/tasks/tasks.h"

namespace intabs {
namespace {

constexpr double kDegree = M_PI / 180;
constexpr double kReach = 0.02;  // [m] from the goal
constexpr double kHalf = 0.022;  // of the cube [m]

class PickPlace final : public Task {
 public:
  std::string name() const override { return "pick_place"; }
  std::vector<TaskObject> objects() const override {
    return {{"block", 0, -15 * kDegree, 0.28, kHalf}, {"goal", 1, 15 * kDegree, 0.30, 0}};
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
    if ((block.q * Eigen::Vector3d::UnitZ()).z() < 0.95) return "block fell over";
    if (std::abs(block.p.z() - kHalf) > 0.005) return "block does not stand on the table";
    if (v.LinearSpeed("block") > 0.01 || v.AngularSpeed("block") > 0.1) return "block not at rest";
    if (distance > kReach) return "block over 2 cm from the goal";
    return "";
  }
};

}  // namespace

const Task& PickPlaceTask() {
  static const PickPlace task;
  return task;
}

}  // namespace intabs
