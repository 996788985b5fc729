// pour: take the cup by its handle, pour its beads into the bowl, turn it upright again.
#include "intabs/plant/tasks/tasks.h"

namespace intabs {
namespace {

constexpr double kShare = 0.8;  // of the beads

class Pour final : public Task {
 public:
  std::vector<TaskObject> objects() const override {
    return {{.body = "cup",
             .slot = 0,
             .id = 4,
             .azimuth = -25 * kDegree,
             .radius = 0.43,
             .footprint = {{0, 0, 0.045}, {-0.06, 0, 0.035}}},
            {.body = "bowl", .slot = 1, .id = 5, .azimuth = 16 * kDegree, .radius = 0.38, .footprint = {{0, 0, 0.055}}}};
  }
  std::vector<Disc> kept_free() const override { return {kGroundTag}; }
  std::string beads_in() const override { return "cup"; }
  std::vector<std::string> subgoals() const override { return {"cup grasped", "cup lifted", "poured", "cup upright"}; }

  uint32_t Subgoals(const TaskView& v) const override {
    const bool grasped = v.gripper_closed && v.FingersTouch("cup");
    const bool lifted = grasped && v.Body("cup").p.z() > 0.02;
    const bool poured = Poured(v);
    return uint32_t{grasped} | uint32_t{lifted} << 1 | uint32_t{poured} << 2 | uint32_t{poured && CupUpright(v)} << 3;
  }

  std::string Missing(const TaskView& v) const override {
    if (v.Upright("bowl") < kUpright) return "bowl tipped over";
    if (!Poured(v)) return "under 80 % of the beads in the bowl";
    if (!CupUpright(v)) return "cup not upright";
    return "";
  }

 private:
  static bool Poured(const TaskView& v) { return v.BeadsIn("bowl") >= kShare * v.Beads(); }
  static bool CupUpright(const TaskView& v) { return v.Upright("cup") > kUpright; }
};

}  // namespace

std::unique_ptr<Task> MakePour() { return std::make_unique<Pour>(); }

}  // namespace intabs
