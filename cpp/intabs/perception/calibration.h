// What cameras and arm must be told about each other: lens, place of the camera, place of the arm. Each
// function throws std::runtime_error with one line that says why when the set it is given cannot answer the
// question. Not real-time safe.
#pragma once

#include <opencv2/core.hpp>
#include <optional>
#include <string>
#include <vector>

#include "intabs/perception/config.h"
#include "intabs/perception/reprojection.h"

namespace intabs {

// A chessboard with columns x rows inner corners, or (marker > 0) a ChArUco board of columns x rows squares
// of DICT_6X6_250.
struct Board {
  int columns = 0, rows = 0;
  double square = 0;  // edge [m]
  double marker = 0;  // edge [m]; 0: chessboard
};

struct BoardView {
  std::string name;                  // for messages
  std::vector<cv::Point3f> points;   // on the board [m]
  std::vector<cv::Point2f> corners;  // px of the picture
};

// The board in a grey picture; nothing when it is not wholly there (ChArUco: fewer than 8 of its corners).
std::optional<BoardView> FindBoard(const cv::Mat& gray, const Board& board);

struct Intrinsics {
  CameraModel model;           // without name
  double rms_px = 0;           // of the views used
  double held_out_rms_px = 0;  // of each fifth of the views, by a calibration from the others
  double coverage = 0;         // share of the picture's 8 x 6 cells with a corner in them
  double tilt = 0;             // [rad] the most tilted view
  int views = 0;
  std::vector<std::string> dropped;  // views that do not fit the others
};

// Focal lengths, centre, k1 k2 p1 p2; k3 where the views can tell it from 0. Refuses fewer than 8 views, a
// coverage below 40 %, boards that are hardly tilted (focal length and distance look alike then), rms over
// max_rms_px.
Intrinsics CalibrateIntrinsics(const std::vector<BoardView>& views, cv::Size size, double max_rms_px = 0.5);

struct Extrinsics {
  Pose X_WC;
  double rms_px = 0;                  // of the mean corners
  double spread_px = 0;               // RMS distance of single frames' corners from their mean
  double sigma_m = 0, sigma_rad = 0;  // standard deviations, the largest axis
  int frames = 0;
};

// From the ground tag's corners (ideal pixels) in frames of a camera that stands still. Refuses fewer than 10
// frames, a tag below 20 px, a camera that moved meanwhile, two poses that explain the tag alike, rms over 1
// px.
Extrinsics CalibrateExtrinsics(const CameraModel& camera, const GroundTag& ground,
                               const std::vector<TagCorners>& frames);

// A tag on the flange, seen while the arm rests.
struct HandEyeSample {
  std::string name;  // for messages
  Pose X_BE;         // flange in the base, from the joints
  struct View {
    int camera = 0;      // index of the placed cameras
    TagCorners corners;  // ideal pixels
  };
  std::vector<View> views;  // none: not seen
};

struct HandEye {
  Pose X_WB, X_ET;                    // arm base in W; tag in the flange
  double rms_px = 0;                  // of the samples used
  double rms_m = 0;                   // tag: where cameras see it from where the arm puts it
  double sigma_m = 0, sigma_rad = 0;  // of X_WB: standard deviations, the largest axis
  double turn = 0;                    // [rad] the largest angle between two samples
  double spread = 0;                  // 0: all turns about one axis, 1: about all axes alike
  int samples = 0;
  std::vector<std::string> dropped;  // samples that do not fit the others
};

// Start: Shah's solution of A X = Z B (OpenCV's calibrateRobotWorldHandEye); then least squares over the
// corners. Refuses fewer than 8 samples, turns that are too small or about one axis only, rms over
// max_rms_px.
HandEye CalibrateHandEye(const std::vector<PlacedCamera>& cameras, double tag_size,
                         const std::vector<HandEyeSample>& samples, double max_rms_px = 1.5);

}  // namespace intabs
