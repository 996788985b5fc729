// MuJoCo behind the arm's joints: one task's world. Deterministic: the same seed and targets give the same
// states. One thread at a time. Nothing here is real-time safe.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "intabs/core/types.h"

struct mjModel_;
struct mjData_;

namespace intabs {

class Task;

// What the arm's controller wants for the next driver tick.
struct ServoTarget {
  JointVector q = JointVector::Zero();   // [rad]
  JointVector dq = JointVector::Zero();  // [rad/s], feed-forward: without it the servo lags 20 ms
  bool gripper_closed = false;
};

struct ArmMeasurement {
  JointVector q, dq, tau;  // [rad], [rad/s], [Nm]
  double gripper_opening;  // both fingers together [m]
};

// Whom the objects touch, by slot, as in PlantTruth (core/types.h).
struct Contacts {
  std::array<uint8_t, kMaxObjects> touches{};
  std::array<int16_t, kMaxObjects> beads_in{};  // inside this vessel
  int16_t beads = 0;                            // in the world
};

// What rendering needs of a state; reused without allocation.
struct Snapshot {
  double time = 0;
  std::vector<double> qpos, mocap_pos, mocap_quat;
};

class World {
 public:
  static constexpr double kMaxSpread = 15;  // [cm]: further out objects stand in the robot's base

  // Loads models_dir/scenes/<task>.xml. Throws on an unknown task, a missing or broken file.
  World(const std::string& models_dir, const std::string& task);
  ~World();
  World(const World&) = delete;
  World& operator=(const World&) = delete;

  // Time zero, arm at home with open gripper, each object uniform in a disc of `spread_cm` about its nominal
  // place, yaw uniform within 3 degrees per cm (30 at most); fixed furniture too; beads at rest in their vessel.
  // Throws if spread_cm is not within 0 .. kMaxSpread.
  void Reset(int64_t seed, double spread_cm);

  // Moves the object of a slot by dp_W [m] at once, as a hand that knocks against it; furniture stands elsewhere then.
  // Throws if the task has no object there.
  void Nudge(int slot, const Eigen::Vector3d& dp_W);

  // One driver tick: 4 ms, gravity compensated servos. Throws when the target is not finite or the
  // simulation breaks down.
  void Step(const ServoTarget& target);

  int64_t time_us() const;
  ArmMeasurement Arm() const;
  std::array<TrackedObject, kMaxObjects> Objects() const;  // the truth: valid, no covariance, age 0
  Contacts Touches() const;

  std::vector<std::string> SubgoalNames() const;
  uint32_t Subgoals() const;  // those that hold now
  bool Success() const;
  std::string FailureReason() const;  // empty when it is a success
  uint64_t StateHash() const;         // of positions and velocities, and of where the furniture stands

  void Save(Snapshot& s) const;
  std::shared_ptr<const mjModel_> model() const { return model_; }
  const Task& task() const { return *task_; }

  static JointVector Home();  // tip at (.22, 0, .20), pointing down [rad]

 private:
  struct View;
  void Place(const std::vector<Pose>& poses);
  void FillVessel(int site);
  void PhysicsStep();

  const std::unique_ptr<Task> task_;
  std::shared_ptr<mjModel_> model_;
  std::unique_ptr<mjData_, void (*)(mjData_*)> data_;
  std::array<int, kNumJoints> joint_qpos_, joint_dof_, joint_actuator_;
  std::array<double, kNumJoints> servo_damping_{};  // where MuJoCo's joints do it for the servos [Nm s]
  std::array<int, 2> finger_qpos_;
  std::vector<int> compensated_dofs_;
  std::vector<int> beads_;  // bodies
  int gripper_actuator_ = 0;
  bool gripper_closed_ = false;
  int64_t ticks_ = 0;
};

}  // namespace intabs
