// Key points of a hand: 21 places in a colour picture and the depth picture aligned with it -> points in W.
// First each frame by itself (LiftHand), then the sequence (FilterHand): detections that stick to one place
// of the picture, bones no hand has, jumps, short gaps. The order is MediaPipe's: wrist 0, thumb 1-4, index
// 5-8, middle 9-12, ring 13-16, little 17-20, each from the palm to the tip.
#pragma once

#include <array>
#include <cstdint>
#include <opencv2/core/mat.hpp>
#include <span>
#include <vector>

#include "intabs/core/pose.h"
#include "intabs/perception/camera_model.h"
#include "intabs/perception/gaps.h"

namespace intabs {

inline constexpr int kHandPoints = 21;

enum class PointState : uint8_t {  // the first three as in SampleState
  kUnseen = 0,                     // no 2-D key point there
  kMeasured = 1,
  kFilled = 2,
  // Seen, but thrown out, because
  kNoDepth = 3,     // no depth around it, or none near the palm's
  kFixedPlace = 4,  // the detection sticks to a place of the picture where no hand goes
  kBone = 5,        // a bone would be too long
  kJump = 6,        // nobody moves that fast
};
inline constexpr int kNumPointStates = 7;

using HandPixels =
    std::array<Eigen::Vector2d, kHandPoints>;        // px as in CameraModel; not finite or over 2e4: not seen
using HandDepths = std::array<double, kHandPoints>;  // along the optical axis [m]; <= 0 or NaN: none

struct HandPoints {
  HandPoints() { p.fill(Eigen::Vector3d::Zero()); }
  std::array<Eigen::Vector3d, kHandPoints> p;  // [m]; zero where nothing is known
  std::array<PointState, kHandPoints> state{};
};

enum class DepthMethod {
  kRobust,    // median of what lies near the palm's depth: a finger's neighbour may be the wall behind
  kGaussian,  // the thesis': Gaussian weighted mean of all depths around the key point
};

struct LiftOptions {
  DepthMethod method = DepthMethod::kRobust;
  int reach_px = 5;          // K: the window is 2 K + 1 wide
  double gaussian_px = 2.5;  // standard deviation of the thesis' weights
  double palm_gate = 0.06;   // [m]
  // The joint lies behind the skin that the camera sees [m]: half a finger, 16 to 18 mm wide at its joints.
  double joint_depth = 0.008;
};

// depth: (H, W) CV_16UC1, `unit` m a count, 0: nothing there; of the size and place of the colour picture
// that `pixels` were found in. Points in C. Throws std::invalid_argument, one line, for a picture of another
// type or size than the camera's.
HandPoints LiftHand(const CameraModel& camera, const HandPixels& pixels, const cv::Mat& depth, double unit,
                    const LiftOptions& options = {});

// The same where one depth a key point is all there is. kGaussian believes each.
HandPoints LiftHand(const CameraModel& camera, const HandPixels& pixels, const HandDepths& depths,
                    const LiftOptions& options = {});

struct HandFilterOptions {
  bool fixed_place = true, bones = true, jumps = true;
  // A bone may be so much longer than the table's [share of it, m]: people differ by 10 %, surfaces by a
  // finger.
  double bone_share = 0.3, bone_slack = 0.02;
  double speed = 2.0;               // of the palm [m/s]
  double finger_speed = 1.5;        // of a key point beside the palm [m/s]
  double jump_slack = 0.025;        // what noise may add [m]
  double still_px = 3.0;            // a detection that moves less sticks
  bool goes_on = false;             // more frames follow: what leapt just now has had no time to move
  GapOptions gaps{.sigma = 0.005};  // max_gap 0: nothing is filled
};

// One frame of a sequence: key points in the picture, and what LiftHand made of them.
struct HandFrame {
  double time = 0;  // [s], rising
  HandPixels pixels;
  HandPoints hand_C;
  Pose X_WC;
};

// The filtered sequence in W, one for each frame. Throws std::invalid_argument, one line, when time does not
// rise.
std::vector<HandPoints> FilterHand(std::span<const HandFrame> frames, const HandFilterOptions& options = {});

// The parts of FilterHand, each on its own.
// Marks kFixedPlace: detections that keep to one place of the picture within still_px, reached or left by a
// leap, and that no moving hand ever passes.
void DropFixedPlaces(std::span<const HandFrame> frames, std::span<HandPoints> hands, double still_px,
                     bool goes_on = false);
// Marks kBone: the fewest points, the worst first, so that no bone and no reach from the wrist is too long. A
// palm of half the size or less is no hand: all of it goes.
void DropLongBones(HandPoints& hand, double share, double slack);
// Marks kJump: keeps the longest chain of frames, then of each key point beside the palm, in which no step is
// faster than allowed. Unlike a gate on the last accepted point it cannot lock on to an outlier.
void DropJumps(std::span<const double> time, std::span<HandPoints> hands, const HandFilterOptions& options);

struct Bone {
  int a, b;       // key points
  double length;  // [m]
};
// Lengths between MediaPipe's key points: X-rays of 66 adults for the fingers (the fingertip lies 4 mm past
// the bone), MediaPipe's own mean for the palm, whose wrist takes in the carpus.
std::span<const Bone> HandBones();

}  // namespace intabs
