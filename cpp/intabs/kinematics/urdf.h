// Arms from URDF files. Set-up only. All functions throw std::runtime_error with one line that names the
// file.
#pragma once

#include <string>

#include "intabs/kinematics/arm_model.h"

namespace KDL {
class Chain;
}

namespace intabs {

// Kinematics and joint limits of the six revolute joints between the links `base` and `tip`; each must turn
// about the z axis of its own frame, as in every URDF of this arm. What lies behind the sixth joint is X_EG.
ArmModel LoadArmModel(const std::string& urdf_path, const std::string& base = "link_base",
                      const std::string& tip = "tip");

// The same chain for KDL, with the links' inertias. Bodies beside the chain (the gripper's) are not in it.
KDL::Chain LoadKdlChain(const std::string& urdf_path, const std::string& base = "link_base",
                        const std::string& tip = "tip");

}  // namespace intabs
