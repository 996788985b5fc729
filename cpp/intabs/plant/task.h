// A task of the plant: its objects, how a seed places them, and what counts as success, measured on the state.
// To add one: see README.md.
#pragma once

#include <mujoco/mujoco.h>

#include <cstdint>
#include <memory>
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

// Part of the table that an object needs for itself, in the frame that the seed places [m].
struct Disc {
  double x = 0, y = 0, radius = 0;
};

// An object that perception and control know, by slot.
struct TaskObject {
  std::string body;  // in the scene; its frame is what is reported
  int slot = 0;      // in OBJECT_POSES
  int id = 0;
  // Nominal place about the base [rad, m] of what the seed moves: the body, which is then free or a mocap body,
  // or the mocap body `base` that carries it. x points away from the robot's base, turned by `turn`.
  double azimuth = 0;
  double radius = 0;
  double height = 0;  // of the placed body's frame
  double turn = 0;
  std::string base{};  // fixed furniture; a body that is free stands to it as in the scene's file
  std::vector<Disc> footprint = {{0, 0, 0.045}};
};

// What a task may look at, by the names of the scene. That its objects are there is checked when the World is made.
struct TaskView {
  const mjModel* model = nullptr;
  const mjData* data = nullptr;
  bool gripper_closed = false;  // commanded

  Pose Body(const std::string& name) const;
  // Cosine of the angle between the body's z axis and the vertical.
  double Upright(const std::string& name) const;
  // Speed of a body [m/s] and [rad/s].
  double LinearSpeed(const std::string& name) const;
  double AngularSpeed(const std::string& name) const;
  // Of a hinge or slide [rad] or [m], and per second.
  double Joint(const std::string& name) const;
  double JointSpeed(const std::string& name) const;
  // True while a finger touches any geom of the body.
  bool FingersTouch(const std::string& name) const;

  // A vessel is a body that has a cylindrical site "<body>_inside".
  int Beads() const;  // in the world
  int BeadsIn(const std::string& vessel) const;
  // Site "<body>_tip" in a vessel's frame of "<vessel>_inside", z along its axis, and whether it is inside.
  Eigen::Vector3d Tip(const std::string& body, const std::string& vessel) const;
  bool TipInside(const std::string& body, const std::string& vessel) const;
};

// One run of a task: it may remember what happened (Watch).
class Task {
 public:
  virtual ~Task() = default;
  virtual std::vector<TaskObject> objects() const = 0;
  // Parts of the table, in W, where none of the objects may start.
  virtual std::vector<Disc> kept_free() const { return {}; }
  // The body in which the scene's beads lie at the start; empty: the task has none.
  virtual std::string beads_in() const { return ""; }
  virtual std::vector<std::string> subgoals() const = 0;
  virtual void Restart() {}
  virtual void Watch(const TaskView& /*view*/) {}              // after each driver tick
  virtual uint32_t Subgoals(const TaskView& view) const = 0;  // bit i: sub-goal i holds now
  // Empty: the task is done. Otherwise what is missing.
  virtual std::string Missing(const TaskView& view) const = 0;
};

// All that the World knows: tasks, then compositions like "pour+stir".
const std::vector<std::string>& TaskNames();
// A composition is done when all its parts are; its sub-goals are theirs, one after the other. Of an object that
// several parts name, the first one's place counts. Throws and lists the known ones.
std::unique_ptr<Task> MakeTask(const std::string& name);

}  // namespace intabs
