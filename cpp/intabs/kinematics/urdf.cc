#include "intabs/kinematics/urdf.h"

#include <console_bridge/console.h>
#include <urdf_parser/urdf_parser.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <kdl/chain.hpp>
#include <sstream>
#include <stdexcept>
#include <vector>

namespace intabs {
namespace {

// The URDF and the joints from base to tip, fixed ones included.
struct UrdfChain {
  urdf::ModelInterfaceSharedPtr model;  // owns what the joints refer to
  std::vector<urdf::JointSharedPtr> joints;
};

[[noreturn]] void Fail(const std::string& path, const std::string& what) {
  throw std::runtime_error(path + ": " + what);
}

UrdfChain LoadChain(const std::string& path, const std::string& base, const std::string& tip) {
  std::ifstream file(path);
  if (!file || !std::filesystem::is_regular_file(path))
    Fail(path, "cannot be read; give the path of the arm's URDF file");
  const std::string text((std::istreambuf_iterator<char>(file)), std::istreambuf_iterator<char>());
  console_bridge::noOutputHandler();  // urdfdom would print its complaints
  const urdf::ModelInterfaceSharedPtr model = urdf::parseURDF(text);
  console_bridge::restorePreviousOutputHandler();
  if (!model) Fail(path, "is not a valid URDF file (check_urdf says where)");

  if (!model->getLink(base)) Fail(path, "has no link \"" + base + "\", where the arm should begin");
  urdf::LinkConstSharedPtr link = model->getLink(tip);
  if (!link) Fail(path, "has no link \"" + tip + "\", where the arm should end");
  UrdfChain chain{model, {}};
  while (link->name != base) {
    if (!link->parent_joint)
      Fail(path, "no joint leads from \"" + link->name + "\" towards \"" + base + "\"");
    chain.joints.push_back(link->parent_joint);
    link = model->getLink(link->parent_joint->parent_link_name);
  }
  std::reverse(chain.joints.begin(), chain.joints.end());
  return chain;
}

Pose ToPose(const urdf::Pose& X) {
  return {{X.position.x, X.position.y, X.position.z},
          Eigen::Quaterniond(X.rotation.w, X.rotation.x, X.rotation.y, X.rotation.z).normalized()};
}

KDL::Frame ToKdl(const urdf::Pose& X) {
  return KDL::Frame(KDL::Rotation::Quaternion(X.rotation.x, X.rotation.y, X.rotation.z, X.rotation.w),
                    KDL::Vector(X.position.x, X.position.y, X.position.z));
}

// About the centre of mass, turned into the link's axes.
KDL::RigidBodyInertia ToKdl(const urdf::Inertial& in) {
  const KDL::Frame X_LC = ToKdl(in.origin);
  const Eigen::Matrix3d R = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(X_LC.M.data);
  Eigen::Matrix3d I;
  I << in.ixx, in.ixy, in.ixz, in.ixy, in.iyy, in.iyz, in.ixz, in.iyz, in.izz;
  I = R * I * R.transpose();
  return KDL::RigidBodyInertia(in.mass, X_LC.p,
                               KDL::RotationalInertia(I(0, 0), I(1, 1), I(2, 2), I(0, 1), I(0, 2), I(1, 2)));
}

}  // namespace

ArmModel LoadArmModel(const std::string& path, const std::string& base, const std::string& tip) {
  const UrdfChain chain = LoadChain(path, base, tip);
  ArmParameters arm;
  Pose X;  // from the last moving joint's frame
  int n = 0;
  std::string names;
  for (const auto& joint : chain.joints) {
    X = X * ToPose(joint->parent_to_joint_origin_transform);
    if (joint->type == urdf::Joint::FIXED) continue;
    names += " " + joint->name;
    if (joint->type != urdf::Joint::REVOLUTE)
      Fail(path, "joint \"" + joint->name + "\" is not of type revolute");
    const urdf::Vector3& a = joint->axis;
    if (a.x != 0 || a.y != 0 || a.z != 1) {
      std::ostringstream axis;
      axis << a.x << " " << a.y << " " << a.z;
      Fail(path, "joint \"" + joint->name + "\" has axis \"" + axis.str() +
                     "\", this arm model needs \"0 0 1\"; turn the joint's origin instead");
    }
    if (!joint->limits || !(joint->limits->lower < joint->limits->upper)) {
      Fail(path, "joint \"" + joint->name + "\" needs limits with lower < upper");
    }
    if (n < kNumJoints) {
      arm.X_PJ[n] = X;
      arm.q_min[n] = joint->limits->lower;
      arm.q_max[n] = joint->limits->upper;
    }
    X = Pose();
    ++n;
  }
  if (n != kNumJoints) {
    Fail(path, "has " + std::to_string(n) + " moving joints between \"" + base + "\" and \"" + tip + "\" (" +
                   (names.empty() ? "none" : names.substr(1)) + "), the arm needs " +
                   std::to_string(kNumJoints));
  }
  arm.X_EG = X;
  for (const Pose& pose : arm.X_PJ) {
    if (!pose.IsFinite()) Fail(path, "a joint origin is not finite");
  }
  if (!arm.X_EG.IsFinite()) Fail(path, "the tip's origin is not finite");
  return ArmModel(arm);
}

KDL::Chain LoadKdlChain(const std::string& path, const std::string& base, const std::string& tip) {
  const UrdfChain chain = LoadChain(path, base, tip);
  KDL::Chain out;
  for (const auto& joint : chain.joints) {
    const KDL::Frame X = ToKdl(joint->parent_to_joint_origin_transform);
    const KDL::Vector axis(joint->axis.x, joint->axis.y, joint->axis.z);
    KDL::Joint kdl_joint(joint->name, KDL::Joint::Fixed);
    if (joint->type == urdf::Joint::REVOLUTE || joint->type == urdf::Joint::CONTINUOUS) {
      kdl_joint = KDL::Joint(joint->name, X.p, X.M * axis, KDL::Joint::RotAxis);
    } else if (joint->type == urdf::Joint::PRISMATIC) {
      kdl_joint = KDL::Joint(joint->name, X.p, X.M * axis, KDL::Joint::TransAxis);
    } else if (joint->type != urdf::Joint::FIXED) {
      Fail(path, "joint \"" + joint->name + "\" is of a type that a chain cannot hold");
    }
    const urdf::LinkConstSharedPtr link = chain.model->getLink(joint->child_link_name);
    out.addSegment(KDL::Segment(link->name, kdl_joint, X,
                                link->inertial ? ToKdl(*link->inertial) : KDL::RigidBodyInertia::Zero()));
  }
  return out;
}

}  // namespace intabs
