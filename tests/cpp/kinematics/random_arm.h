// Seeded random joint angles, and how tests say them.
#pragma once

#include <random>
#include <sstream>
#include <string>

#include "intabs/kinematics/arm_model.h"

namespace intabs {

inline const std::string kUrdf = INTABS_SOURCE_DIR "/models/lite6/lite6.urdf";
inline const std::string kMjcf = INTABS_SOURCE_DIR "/models/lite6/lite6.xml";

// Uniform within the joint limits.
inline JointVector RandomJoints(const ArmModel& model, std::mt19937_64& random) {
  JointVector q;
  for (int i = 0; i < kNumJoints; ++i) {
    q[i] = std::uniform_real_distribution<double>(model.q_min()[i], model.q_max()[i])(random);
  }
  return q;
}

inline std::string Say(const JointVector& q) {
  std::ostringstream text;
  text.precision(17);
  text << "q = " << q.transpose();
  return text.str();
}

}  // namespace intabs
