#include "intabs/lite6/errors.h"

namespace intabs::lite6 {
namespace {

constexpr char kPowerCycle[] =
    "restart with the controller's emergency stop button; if it comes back, ask the vendor";

constexpr VendorCode kErrors[] = {
    {0, "no error", "", ""},
    {1, "emergency stop button pressed", "the button on the controller is pushed in",
     "release it by turning, make sure nobody is in reach, then send RESET"},
    {2, "emergency stop input open", "the controller's emergency inputs (EI) are not closed",
     "close both EI contacts to ground, then send RESET"},
    {3, "three-state switch released", "the enabling switch is pressed through or let go",
     "release its emergency stop, then send RESET"},
    {10, "servo motor error", "a joint's motor driver reports an error", kPowerCycle},
    {11, "joint 1 error", "its motor driver reports over-current, over-speed, heat or an encoder fault", kPowerCycle},
    {12, "joint 2 error", "its motor driver reports over-current, over-speed, heat or an encoder fault", kPowerCycle},
    {13, "joint 3 error", "its motor driver reports over-current, over-speed, heat or an encoder fault", kPowerCycle},
    {14, "joint 4 error", "its motor driver reports over-current, over-speed, heat or an encoder fault", kPowerCycle},
    {15, "joint 5 error", "its motor driver reports over-current, over-speed, heat or an encoder fault", kPowerCycle},
    {16, "joint 6 error", "its motor driver reports over-current, over-speed, heat or an encoder fault", kPowerCycle},
    {17, "joint 7 error", "the controller believes in a seventh joint: its configuration is of another arm",
     "check the serial numbers of arm and controller"},
    {18, "force sensor communication", "a force-torque sensor is configured but does not answer",
     "connect it or switch it off in the vendor's studio, then send RESET"},
    {19, "end effector communication", "a bus gripper was addressed that is not there; the Lite 6 gripper is no bus gripper",
     "never call the vendor's set_gripper functions on a Lite 6; then send RESET"},
    {21, "kinematic error", "Cartesian motion met a singularity or left the reach",
     "move the arm by joints away from it, then send RESET"},
    {22, "self-collision", "the controller foresees links touching", "guide the arm clear in manual mode, then send RESET"},
    {23, "joint limit exceeded", "a joint target or position is beyond its range",
     "guide the joint back into its range in manual mode, then send RESET"},
    {24, "speed exceeds limit", "joint targets came too far apart for 180 degrees/s",
     "send smoother targets, look for stalls in the network; then send RESET"},
    {25, "planning error", "a motion could not be planned", "change the path or reduce its speed, then send RESET"},
    {26, "controller real-time error", "the controller's own loop is late", "restart the controller; if it comes back, ask the vendor"},
    {27, "command reply error", "a joint does not answer the controller", kPowerCycle},
    {28, "end module communication", "the tool board does not answer", kPowerCycle},
    {30, "measured speed exceeds limit", "a joint turned faster than its limit, often a wrong payload or a push",
     "check payload and mounting, then send RESET"},
    {31, "collision", "motor currents do not fit the model: contact, wrong payload, or friction of a cold arm",
     "free the arm, check payload and collision sensitivity, then send RESET"},
    {32, "circle cannot be calculated", "three points of an arc lie in one line", "change the points, then send RESET"},
    {33, "controller input/output error", "the controller's I/O board reports a fault", "check its wiring, switch it off and on"},
    {34, "recording timeout", "a trajectory recorded in the controller is longer than 5 minutes", "record a shorter one"},
    {35, "safety boundary", "the tool reached the box set in the controller",
     "guide the arm back in manual mode or change the box, then send RESET"},
    {36, "too many delayed commands", "more than 36 delayed outputs wait in the controller", "send fewer, then send RESET"},
    {37, "abnormal movement in manual mode", "the arm sags or drifts while guided: payload or mounting are wrong",
     "set payload and mounting, then send RESET"},
    {38, "abnormal joint angle", "an encoder reads what cannot be", kPowerCycle},
    {39, "power board communication", "the power board's two processors do not talk", "ask the vendor"},
    {40, "no joint trajectory", "no error-free joint path to that pose exists", "choose another pose, then send RESET"},
    {41, "friction file invalid", "the controller's friction data is damaged", kPowerCycle},
    {42, "calibration file invalid", "the controller's calibration is damaged", kPowerCycle},
    {50, "force sensor read", "the force-torque sensor cannot be read", "check the sensor, then send RESET"},
    {51, "force sensor mode", "the force-torque sensor refuses its mode", "check the sensor, then send RESET"},
    {52, "force sensor zero", "the force-torque sensor cannot be zeroed", "check the sensor, then send RESET"},
    {53, "force sensor overloaded", "the force-torque sensor is beyond its range", "unload it, then send RESET"},
    {60, "linear speed exceeds limit in servo mode", "the tool was asked to go faster than 600 mm/s (1.2 times 500)",
     "send slower targets, look for stalls in the network; then send RESET"},
    {110, "base board communication", "the arm's base board does not answer", "check the arm's cable; if it comes back, ask the vendor"},
    {111, "external RS-485 communication", "a device on the controller's RS-485 does not answer",
     "check its cable and baud rate, then send RESET"},
};
constexpr VendorCode kUnknownError = {-1, "unknown error", "newer firmware than this list",
                                      "look the code up in the vendor's manual, then send RESET"};

constexpr VendorCode kWarnings[] = {
    {0, "no warning", "", ""},
    {11, "queue full", "more motions were sent than the controller holds", "wait until some are done"},
    {12, "bad parameter", "a parameter is out of its range", "check the request"},
    {13, "unknown command", "the firmware does not know this register", "update the firmware"},
    {14, "no solution", "no inverse kinematics for the given pose", "choose a pose within reach"},
    {15, "Modbus queue full", "too many requests to the tool's bus", "send fewer"},
};
constexpr VendorCode kUnknownWarning = {-1, "unknown warning", "newer firmware than this list",
                                        "look the code up in the vendor's manual"};

template <size_t n>
const VendorCode& Find(const VendorCode (&table)[n], int code, const VendorCode& unknown) noexcept {
  for (const VendorCode& entry : table) {
    if (entry.code == code) return entry;
  }
  return unknown;
}

std::string Line(char letter, int code, const VendorCode& e) {
  std::string line = letter + std::to_string(code) + " " + e.name;
  if (*e.cause != '\0') line += std::string(": ") + e.cause + "; " + e.cure;
  return line;
}

}  // namespace

const VendorCode& DescribeError(int code) noexcept { return Find(kErrors, code, kUnknownError); }
const VendorCode& DescribeWarning(int code) noexcept { return Find(kWarnings, code, kUnknownWarning); }
std::string ErrorLine(int code) { return Line('C', code, DescribeError(code)); }
std::string WarningLine(int code) { return Line('W', code, DescribeWarning(code)); }

}  // namespace intabs::lite6
