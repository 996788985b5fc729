// The Lite 6 and its gripper as simple bodies: what must not touch itself or the table. Numbers only; link
// frames are those of models/lite6/lite6.urdf, whose collision geometry a test holds against them.
#pragma once

#include <array>

namespace intabs::lite6_shape {

// Link 0 is the base, 6 the flange with the gripper. [m]
struct Capsule {
  int link;
  float p0[3], p1[3], radius;
};

// Around every collision geometry of the link. A capsule that ends e inside a cylinder's face and has the
// radius sqrt(r^2 + e^2) holds the rim.
inline constexpr std::array<Capsule, 12> kCapsules = {{
    {0, {-.062f, .032f, .0425f}, {.041f, .032f, .0425f}, .0568f},    // 0: base box, left
    {0, {-.062f, -.032f, .0425f}, {.041f, -.032f, .0425f}, .0568f},  // 1: base box, right
    {0, {0, 0, .080f}, {0, 0, .165f}, .0408f},                       // 2: base column
    {1, {0, 0, -.058f}, {0, 0, -.010f}, .0423f},                     // 3: column
    {1, {0, -.026f, 0}, {0, .061f, 0}, .0435f},                      // 4: shoulder
    {2, {0, 0, .1055f}, {.2002f, 0, .1055f}, .0516f},                // 5: upper arm
    {2, {.2002f, 0, .065f}, {.2002f, 0, .1055f}, .0447f},            // 6: its elbow end
    {3, {0, 0, 0}, {.087f, 0, 0}, .0601f},                           // 7: elbow
    {4, {0, 0, -.174f}, {0, 0, -.060f}, .0454f},                     // 8: forearm
    {4, {0, -.0635f, -.125f}, {0, -.0635f, 0}, .0465f},              // 9: forearm's beam and wrist end
    {5, {0, -.012f, 0}, {0, .010f, 0}, .0575f},                      // 10: wrist
    {6, {0, 0, -.0045f}, {0, 0, .0567f}, .0437f},                    // 11: flange, gripper, fingers
}};

// Capsules that could meet: all but those of links whose bodies overlap at their joints or cannot meet (the
// vendor's list: 0-1 0-2 1-2 1-3 2-3 2-4 3-4 3-5 3-6 4-5 4-6 5-6; the gripper may meet link 3).
struct Pair {
  int a, b;
};
inline constexpr std::array<Pair, 28> kPairs = {{
    {0, 7},  {0, 8},  {0, 9},  {0, 10}, {0, 11},  // base, left
    {1, 7},  {1, 8},  {1, 9},  {1, 10}, {1, 11},  // base, right
    {2, 7},  {2, 8},  {2, 9},  {2, 10}, {2, 11},  // base column
    {3, 8},  {3, 9},  {3, 10}, {3, 11},           // column
    {4, 8},  {4, 9},  {4, 10}, {4, 11},           // shoulder
    {5, 10}, {5, 11}, {6, 10}, {6, 11},           // upper arm
    {7, 11},                                      // elbow and gripper
}};

// Above a table every body counts as it is: cylinders and boxes, not capsules.
struct Cylinder {
  int link;
  float p0[3], p1[3], radius;
};
inline constexpr std::array<Cylinder, 10> kCylinders = {{
    {2, {.2002f, 0, .0457f}, {.2002f, 0, .1376f}, .0400f},
    {3, {0, 0, -.0447f}, {0, 0, .0425f}, .0400f},
    {3, {.087f, -.035f, 0}, {.087f, .039f, 0}, .0395f},
    {4, {0, 0, -.1921f}, {0, 0, -.046f}, .0415f},
    {4, {0, -.0858f, 0}, {0, -.042f, 0}, .0385f},
    {5, {0, 0, -.0393f}, {0, 0, .0415f}, .0388f},
    {5, {0, -.045f, 0}, {0, .0418f, 0}, .0388f},
    {6, {0, 0, -.0245f}, {0, 0, 0}, .0386f},
    {6, {0, 0, 0}, {0, 0, .0567f}, .0388f},
    {2, {.030f, 0, .113f}, {.170f, 0, .113f}, .0472f},  // the upper arm's beam, a box: around it
}};
struct Box {
  int link;
  float centre[3], half[3];
};
inline constexpr std::array<Box, 3> kBoxes = {{
    {3, {.0435f, .002f, -.002f}, {.0435f, .033f, .034f}},
    {4, {0, -.0635f, -.069f}, {.0385f, .0225f, .069f}},
    {6, {0, 0, .06895f}, {.010f, .0245f, .01475f}},  // both fingers, open
}};

}  // namespace intabs::lite6_shape
