#include "intabs/perception/hand.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <opencv2/imgproc.hpp>
#include <stdexcept>
#include <string>

namespace intabs {
namespace {

constexpr int kPalm[] = {0, 5, 9, 13, 17};
constexpr double kNone = std::numeric_limits<double>::quiet_NaN();

constexpr Bone kBones[] = {
    {0, 1, .045},  {1, 2, .046},   {2, 3, .032},   {3, 4, .026},                   // thumb
    {0, 5, .098},  {5, 6, .040},   {6, 7, .024},   {7, 8, .020},                   // index
    {0, 9, .095},  {9, 10, .045},  {10, 11, .026}, {11, 12, .021},                 // middle
    {0, 13, .090}, {13, 14, .041}, {14, 15, .026}, {15, 16, .021},                 // ring
    {0, 17, .088}, {17, 18, .033}, {18, 19, .020}, {19, 20, .020}, {5, 17, .066},  // little; across the palm
};

bool Seen(const Eigen::Vector2d& uv) { return uv.cwiseAbs().maxCoeff() < 2e4 && uv.allFinite(); }

double Median(std::vector<double>& v) {  // reorders
  if (v.empty()) return kNone;
  std::nth_element(v.begin(), v.begin() + v.size() / 2, v.end());
  return v[v.size() / 2];
}

Eigen::Vector3d ToCamera(const CameraModel& camera, const Eigen::Vector2d& uv, double z) {
  const Eigen::Vector2d ideal = camera.Undistort(uv);
  return {(ideal.x() - camera.cx) / camera.fx * z, (ideal.y() - camera.cy) / camera.fy * z, z};
}

// Median depth of the polygon that wrist and finger roots span [counts]: hardly any of it is background,
// however the key points err.
double PalmDepth(const HandPixels& pixels, const cv::Mat& depth) {
  std::vector<cv::Point> corners;
  for (const int i : kPalm) {
    if (Seen(pixels[i])) corners.emplace_back(cvRound(pixels[i].x()), cvRound(pixels[i].y()));
  }
  if (corners.size() < 3) return kNone;
  std::vector<cv::Point> hull;
  cv::convexHull(corners, hull);
  cv::Rect box = cv::boundingRect(hull);
  box.width += 1;
  box.height += 1;
  box &= cv::Rect(0, 0, depth.cols, depth.rows);
  if (box.empty()) return kNone;
  cv::Mat mask = cv::Mat::zeros(box.size(), CV_8UC1);
  for (cv::Point& p : hull) p -= box.tl();
  cv::fillConvexPoly(mask, hull, 255);
  std::vector<double> inside;
  for (int y = 0; y < box.height; ++y) {
    const uint16_t* row = depth.ptr<uint16_t>(box.y + y) + box.x;
    for (int x = 0; x < box.width; ++x) {
      if (mask.at<uint8_t>(y, x) && row[x] > 0) inside.push_back(row[x]);
    }
  }
  return Median(inside);
}

// Depth at a key point [counts], NaN: none.
double PointDepth(const Eigen::Vector2d& uv, const cv::Mat& depth, double palm, double gate,
                  const LiftOptions& options) {
  const int u = cvRound(uv.x()), v = cvRound(uv.y());
  double weights = 0, sum = 0;
  std::vector<double> near;
  for (int y = std::max(0, v - options.reach_px); y <= std::min(depth.rows - 1, v + options.reach_px); ++y) {
    for (int x = std::max(0, u - options.reach_px); x <= std::min(depth.cols - 1, u + options.reach_px);
         ++x) {
      const double z = depth.at<uint16_t>(y, x);
      if (z <= 0) continue;
      if (options.method == DepthMethod::kRobust) {
        if (std::abs(z - palm) <= gate) near.push_back(z);
        continue;
      }
      const double r2 = (Eigen::Vector2d(x, y) - uv).squaredNorm();
      const double w = std::exp(-r2 / (2 * options.gaussian_px * options.gaussian_px));
      weights += w;
      sum += w * z;
    }
  }
  if (options.method == DepthMethod::kRobust) return Median(near);
  return weights > 0 ? sum / weights : kNone;
}

HandPoints Lift(const CameraModel& camera, const HandPixels& pixels, const HandDepths& depths,
                const LiftOptions& options) {
  HandPoints hand;
  const double behind = options.method == DepthMethod::kRobust ? options.joint_depth : 0;
  for (int i = 0; i < kHandPoints; ++i) {
    if (!Seen(pixels[i])) continue;
    if (!(depths[i] > 0)) {
      hand.state[i] = PointState::kNoDepth;
      continue;
    }
    hand.p[i] = ToCamera(camera, pixels[i], depths[i] + behind);
    hand.state[i] = PointState::kMeasured;
  }
  return hand;
}

bool Measured(const HandPoints& hand, int i) { return hand.state[i] == PointState::kMeasured; }

void Drop(HandPoints& hand, PointState why) {
  for (PointState& s : hand.state) {
    if (s == PointState::kMeasured) s = why;
  }
}

// Longest chain of samples i < j < ... in which each step is allowed(i, j). Steps over `window` seconds
// always are. Returns which samples belong to it.
template <class Allowed>
std::vector<bool> LongestChain(std::span<const double> time, const std::vector<bool>& usable, double window,
                               Allowed&& allowed) {
  const int n = static_cast<int>(time.size());
  std::vector<int> length(n, 0), from(n, -1);
  int old = 0, best_old = -1, best = -1;  // best_old: end of the longest chain before the window
  for (int j = 0; j < n; ++j) {
    for (; time[j] - time[old] > window; ++old) {
      if (usable[old] && (best_old < 0 || length[old] > length[best_old])) best_old = old;
    }
    if (!usable[j]) continue;
    if (best_old >= 0) {
      length[j] = length[best_old];
      from[j] = best_old;
    }
    for (int i = j - 1; i >= old; --i) {
      if (usable[i] && length[i] > length[j] && allowed(i, j)) {
        length[j] = length[i];
        from[j] = i;
      }
    }
    ++length[j];
    if (best < 0 || length[j] > length[best]) best = j;
  }
  std::vector<bool> keep(n, false);
  for (; best >= 0; best = from[best]) keep[best] = true;
  return keep;
}

}  // namespace

std::span<const Bone> HandBones() { return kBones; }

HandPoints LiftHand(const CameraModel& camera, const HandPixels& pixels, const cv::Mat& depth, double unit,
                    const LiftOptions& options) {
  if (depth.type() != CV_16UC1 || depth.cols != camera.width || depth.rows != camera.height) {
    throw std::invalid_argument("hand: a depth picture must be of uint16 and of the camera's size, " +
                                std::to_string(camera.width) + " x " + std::to_string(camera.height) +
                                ", not " + std::to_string(depth.cols) + " x " + std::to_string(depth.rows));
  }
  if (!(unit > 0)) throw std::invalid_argument("hand: the depth's unit is " + std::to_string(unit) + " m");
  const double palm = PalmDepth(pixels, depth);
  HandDepths depths;
  for (int i = 0; i < kHandPoints; ++i) {
    depths[i] = Seen(pixels[i]) ? unit * PointDepth(pixels[i], depth, palm, options.palm_gate / unit, options)
                                : kNone;
  }
  return Lift(camera, pixels, depths, options);
}

HandPoints LiftHand(const CameraModel& camera, const HandPixels& pixels, const HandDepths& depths,
                    const LiftOptions& options) {
  std::vector<double> of_palm;
  for (const int i : kPalm) {
    if (depths[i] > 0) of_palm.push_back(depths[i]);
  }
  const double palm = Median(of_palm);
  HandDepths gated = depths;
  for (double& z : gated) {
    if (options.method == DepthMethod::kRobust && !(std::abs(z - palm) <= options.palm_gate)) z = kNone;
  }
  return Lift(camera, pixels, gated, options);
}

void DropFixedPlaces(std::span<const HandFrame> frames, std::span<HandPoints> hands, double still_px,
                     bool goes_on) {
  // A visit: detections between two leaps or two pauses.
  struct Visit {
    std::vector<size_t> frames;
    Eigen::Vector2d place;  // median centre
    bool still = true, leapt = false;
  };
  const auto seen = [&](size_t k) {
    return std::any_of(frames[k].pixels.begin(), frames[k].pixels.end(), Seen);
  };
  const auto centre = [&](size_t k) {
    Eigen::Vector2d sum = Eigen::Vector2d::Zero();
    int n = 0;
    for (const Eigen::Vector2d& uv : frames[k].pixels) {
      if (Seen(uv)) sum += uv, ++n;
    }
    return Eigen::Vector2d(sum / n);
  };
  const auto size = [&](size_t k) {
    Eigen::Vector2d low = Eigen::Vector2d::Constant(1e9), high = -low;
    for (const Eigen::Vector2d& uv : frames[k].pixels) {
      if (Seen(uv)) low = low.cwiseMin(uv), high = high.cwiseMax(uv);
    }
    return (high - low).norm();
  };
  // In hand's sizes, .2 m: 2 m/s from frame to frame; 1 m/s over a pause, for who rests after it was not that
  // fast.
  constexpr double kPause = 0.1;  // s
  constexpr double kQuick = 10, kBrisk = 5, kNoise = 0.2;
  constexpr double kForgotten = 0.5;  // s; after so long a hand may be anywhere
  std::vector<Visit> visits;
  for (size_t k = 0, last = 0; k < frames.size(); ++k) {
    if (!seen(k)) continue;
    const double dt = frames[k].time - frames[last].time;
    const bool pause = dt > kPause;
    const double leap = std::max(size(k), size(last)) * ((pause ? kBrisk : kQuick) * dt + kNoise);
    const bool leapt = !visits.empty() && dt <= kForgotten && (centre(k) - centre(last)).norm() > leap;
    if (leapt) visits.back().leapt = true;
    if (leapt || pause || visits.empty()) {
      visits.emplace_back();
      visits.back().leapt = leapt;
    }
    visits.back().frames.push_back(k);
    last = k;
  }
  std::vector<Eigen::Vector2d> path;  // of the hand that moves
  for (Visit& v : visits) {
    std::vector<double> x, y;
    for (const size_t k : v.frames) {
      x.push_back(centre(k).x());
      y.push_back(centre(k).y());
    }
    v.place = {Median(x), Median(y)};
    for (const size_t k : v.frames) v.still = v.still && (centre(k) - v.place).norm() <= still_px;
    if (!v.still) {
      for (const size_t k : v.frames) path.push_back(centre(k));
    }
  }
  if (path.empty()) return;  // nothing that moves: nothing to tell a stain from a hand by
  for (const Visit& v : visits) {
    if (!v.still || !v.leapt) continue;
    const bool just_now = v.frames.back() + 1 == frames.size() &&
                          frames[v.frames.back()].time - frames[v.frames.front()].time < kPause;
    if (goes_on && just_now) continue;
    const auto near = [&](const Eigen::Vector2d& at) { return (at - v.place).norm() <= 3 * still_px; };
    if (std::any_of(path.begin(), path.end(), near)) continue;
    for (const size_t k : v.frames) {
      for (int i = 0; i < kHandPoints; ++i) {
        if (Seen(frames[k].pixels[i])) hands[k].state[i] = PointState::kFixedPlace;
      }
    }
  }
}

void DropLongBones(HandPoints& hand, double share, double slack) {
  // Beside the bones: no point is farther from the wrist than its chain is long.
  std::array<double, kHandPoints> reach{};
  for (const Bone& bone : kBones) {
    if (bone.a != 5 || bone.b != 17) reach[bone.b] = reach[bone.a] + bone.length;
  }
  std::array<double, kHandPoints> excess;
  for (;;) {
    excess.fill(0);
    const auto blame = [&](int a, int b, double length) {
      if (!Measured(hand, a) || !Measured(hand, b)) return;
      const double over = (hand.p[a] - hand.p[b]).norm() - ((1 + share) * length + slack);
      if (over > 0) {
        excess[a] += over;
        excess[b] += over;
      }
    };
    for (const Bone& bone : kBones) blame(bone.a, bone.b, bone.length);
    for (int i = 1; i < kHandPoints; ++i) {
      if (std::find(std::begin(kPalm), std::end(kPalm), i) == std::end(kPalm)) blame(0, i, reach[i]);
    }
    const auto worst = std::max_element(excess.begin(), excess.end());
    if (*worst <= 0) break;
    hand.state[worst - excess.begin()] = PointState::kBone;
  }
  double longest = 0;
  int points = 0;
  for (const Bone& bone : kBones) {
    const bool palm = bone.length > 0.06;
    if (palm && Measured(hand, bone.a) && Measured(hand, bone.b)) {
      longest = std::max(longest, (hand.p[bone.a] - hand.p[bone.b]).norm() / bone.length);
    }
  }
  for (int i = 0; i < kHandPoints; ++i) points += Measured(hand, i);
  if (longest < 0.5 || points < 8) Drop(hand, PointState::kBone);
}

void DropJumps(std::span<const double> time, std::span<HandPoints> hands, const HandFilterOptions& options) {
  constexpr double kWindow = 0.5;  // s; over a longer time a hand may go anywhere
  const size_t n = hands.size();
  // The palm first: the median of its points, so that one of them does not move it.
  std::vector<Eigen::Vector3d> palm(n);
  std::vector<bool> usable(n);
  for (size_t k = 0; k < n; ++k) {
    for (int axis = 0; axis < 3; ++axis) {
      std::vector<double> v;
      for (const int i : kPalm) {
        if (Measured(hands[k], i)) v.push_back(hands[k].p[i][axis]);
      }
      usable[k] = v.size() >= 2;
      palm[k][axis] = Median(v);
    }
    if (!usable[k]) Drop(hands[k], PointState::kJump);
  }
  const auto slow = [&](const std::vector<Eigen::Vector3d>& p, double speed) {
    return [&, speed](int i, int j) {
      return (p[i] - p[j]).norm() <= speed * (time[j] - time[i]) + options.jump_slack;
    };
  };
  usable = LongestChain(time, usable, kWindow, slow(palm, options.speed));
  for (size_t k = 0; k < n; ++k) {
    if (!usable[k]) Drop(hands[k], PointState::kJump);
  }
  std::vector<Eigen::Vector3d> beside(n);
  std::vector<bool> there(n);
  for (int i = 0; i < kHandPoints; ++i) {
    for (size_t k = 0; k < n; ++k) {
      there[k] = usable[k] && Measured(hands[k], i);
      if (there[k]) beside[k] = hands[k].p[i] - palm[k];
    }
    const std::vector<bool> keep = LongestChain(time, there, kWindow, slow(beside, options.finger_speed));
    for (size_t k = 0; k < n; ++k) {
      if (there[k] && !keep[k]) hands[k].state[i] = PointState::kJump;
    }
  }
}

std::vector<HandPoints> FilterHand(std::span<const HandFrame> frames, const HandFilterOptions& options) {
  const size_t n = frames.size();
  std::vector<double> time(n);
  std::vector<HandPoints> hands(n);
  for (size_t k = 0; k < n; ++k) {
    time[k] = frames[k].time;
    if (!std::isfinite(time[k]) || (k > 0 && time[k] <= time[k - 1])) {
      throw std::invalid_argument("hand: time does not rise at frame " + std::to_string(k));
    }
    hands[k] = frames[k].hand_C;
    for (int i = 0; i < kHandPoints; ++i) {
      if (Measured(hands[k], i)) hands[k].p[i] = frames[k].X_WC * hands[k].p[i];
    }
  }
  if (options.fixed_place) DropFixedPlaces(frames, hands, options.still_px, options.goes_on);
  if (options.bones) {
    for (HandPoints& hand : hands) DropLongBones(hand, options.bone_share, options.bone_slack);
  }
  if (options.jumps) DropJumps(time, hands, options);

  std::vector<Eigen::Vector3d> point(n);
  std::vector<SampleState> state(n);
  for (int i = 0; i < kHandPoints; ++i) {
    for (size_t k = 0; k < n; ++k) {
      point[k] = hands[k].p[i];
      state[k] = Measured(hands[k], i) ? SampleState::kMeasured : SampleState::kInvalid;
    }
    FillPointGaps(time, point, state, options.gaps);
    for (size_t k = 0; k < n; ++k) {
      if (state[k] == SampleState::kFilled) {
        hands[k].p[i] = point[k];
        hands[k].state[i] = PointState::kFilled;
      } else if (state[k] == SampleState::kInvalid) {
        hands[k].p[i].setZero();
      }
    }
  }
  return hands;
}

}  // namespace intabs
