// stir: take the spoon out of its rack and stir the beads in the bowl with it.
#include "intabs/plant/tasks/tasks.h"

namespace intabs {
namespace {

constexpr double kTurns = 2;
constexpr double kNearAxis = 0.004;  // [m]: nearer to the bowl's axis the tip has no direction
constexpr double kKept = 0.8;        // of the beads: 20 % may be spilt

class Stir final : public Task {
 public:
  std::vector<TaskObject> objects() const override {
    return {{.body = "bowl", .slot = 1, .id = 5, .azimuth = 16 * kDegree, .radius = 0.35, .footprint = {{0, 0, 0.055}}},
            {.body = "spoon",
             .slot = 2,
             .id = 6,
             .azimuth = 40 * kDegree,
             .radius = 0.25,
             .turn = -45 * kDegree,  // its tags face the cameras
             .base = "rack",
             .footprint = {{0, 0, 0.045}, {0.05, 0, 0.035}}}};
  }
  std::vector<Disc> kept_free() const override { return {kGroundTag}; }
  std::string beads_in() const override { return "bowl"; }
  std::vector<std::string> subgoals() const override { return {"spoon grasped", "spoon in the bowl", "stirred"}; }

  void Restart() override {
    turned_ = 0;
    inside_ = false;
  }

  // The tip's angle about the bowl's axis, summed while it is among the beads. Both ways count, but not against each
  // other.
  void Watch(const TaskView& v) override {
    const Eigen::Vector3d tip = v.Tip("spoon", "bowl");
    const bool inside = v.TipInside("spoon", "bowl") && tip.head<2>().norm() > kNearAxis && 2 * v.BeadsIn("bowl") > v.Beads();
    const double angle = std::atan2(tip.y(), tip.x());
    if (inside && inside_) turned_ += std::remainder(angle - angle_, 2 * M_PI);
    inside_ = inside;
    angle_ = angle;
  }

  uint32_t Subgoals(const TaskView& v) const override {
    const bool grasped = v.gripper_closed && v.FingersTouch("spoon");
    return uint32_t{grasped} | uint32_t{v.TipInside("spoon", "bowl")} << 1 | uint32_t{Stirred()} << 2;
  }

  std::string Missing(const TaskView& v) const override {
    if (v.Upright("bowl") < kUpright) return "bowl tipped over";
    if (!Stirred()) return "spoon turned less than twice in the bowl";
    if (v.BeadsIn("bowl") < kKept * v.Beads()) return "over 20 % of the beads spilt";
    return "";
  }

 private:
  bool Stirred() const { return std::abs(turned_) >= kTurns * 2 * M_PI; }

  double turned_ = 0;  // [rad]
  double angle_ = 0;
  bool inside_ = false;
};

}  // namespace

std::unique_ptr<Task> MakeStir() { return std::make_unique<Stir>(); }

}  // namespace intabs
