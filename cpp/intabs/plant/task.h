// A task of the plant: its scene, its objects, how a seed places them, and what counts as success.
// To add one: a file in tasks/, a line in Tasks() of tasks.cc, a scene in models/scenes.
#pragma once

#include <mujoco/mujoco.h>

#include <cstdint>
#include <random>
#include <string>
#include <vector>

#include "intabs/core/types.h"

namespace intabs {

// Uniform numbers that are the same with every standard library.
class Random {
 public:
  explicit Random(uint64_t seed) : engine_(seed) {}
  double Uniform(double a, double b) {
    return a + (b - a) * (static_cast<double>(engine_() >> 11) * 0x1p-53);
  }

 private:
  std::mt19937_64 engine_;
};

// An object that perception and control know, by slot.
struct TaskObject {
  std::string body;    // in the scene; a free body or a mocap body
  int id = 0;          // in OBJECT_POSES
  double azimuth = 0;  // nominal place about the base [rad], the object's x axis points away from the base
  double radius = 0;   // [m]
  double height = 0;   // of the body's frame [m]
};

// What a task may look at, by the names of the scene. That its objects are there is checked when the World is made.
struct TaskView {
  const mjModel* model = nullptr;
  const mjData* data = nullptr;
  bool gripper_closed = false;  // commanded

  Pose Body(const std::string& name) const;
  // Speed of a body [m/s] and [rad/s].
  double LinearSpeed(const std::string& name) const;
  double AngularSpeed(const std::string& name) const;
  // True while a finger touches any geom of the body.
  bool FingersTouch(const std::string& name) const;
};

class Task {
 public:
  virtual ~Task() = default;
  virtual std::string name() const = 0;
  virtual std::vector<TaskObject> objects() const = 0;  // slots 0, 1, ...
  virtual std::vector<std::string> subgoals() const = 0;
  virtual uint32_t Subgoals(const TaskView& view) const = 0;  // bit i: sub-goal i holds now
  // Empty: the task is done. Otherwise what is missing.
  virtual std::string Missing(const TaskView& view) const = 0;
};

const std::vector<const Task*>& Tasks();
const Task& FindTask(const std::string& name);  // throws and lists the known ones

}  // namespace intabs
