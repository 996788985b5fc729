// AprilTag 36h11 in one camera's grey images: at full resolution where tags are expected, decimated in the
// whole frame for new and lost ones, within a budget. The answer depends on the frames given so far, never on
// time or threads.
#pragma once

#include <cstdint>
#include <memory>
#include <opencv2/core/mat.hpp>
#include <span>
#include <vector>

#include "intabs/perception/reprojection.h"

namespace intabs {

struct SeenTag {
  int id = -1;
  TagCorners corners;                      // px, half-pixel corrected, refined (refine.h)
  Matrix8d covariance = Matrix8d::Zero();  // of the corners [px^2]
  float decision_margin = 0;
};

struct DetectorOptions {
  int threads = 1;
  // Pixels of full resolution that one frame may cost; a decimated one counts as one. 0: as many as it takes.
  // The first frame may cost a whole one in any case.
  int64_t budget_px = 0;
};

class TagDetector {
 public:
  explicit TagDetector(std::vector<int> ids,
                       const DetectorOptions& options = {});  // reports these; all, when empty
  ~TagDetector();
  TagDetector(TagDetector&&) noexcept;
  TagDetector& operator=(TagDetector&&) noexcept;

  // gray: (H, W) CV_8UC1, at least 16 x 16 (smaller or empty: no tags).
  //
  // expected: where the caller knows of tags to look for, beside those of the last frame. Regions are looked
  // at in full resolution; when they cost more than the budget, those left out come first next time.
  //
  // scan: look for new tags too: without a budget in the whole frame; with one in the whole frame at half
  // resolution, and in a quarter of it, another one each time, at full resolution, for small tags. A frame
  // that lacks a tag of the frame before is scanned in any case, at full resolution as far as the budget
  // goes; so is the first one.
  //
  // Tags come sorted by id, each id at most once. Throws std::runtime_error for an image of another type.
  const std::vector<SeenTag>& Detect(const cv::Mat& gray, std::span<const cv::Rect> expected, bool scan);

  void Reset();  // as new

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

// AprilTag itself on whole frames at full resolution: what everything else is measured against.
class LibraryDetector {
 public:
  struct Options {
    bool refine_edges = true;  // the library's own default
  };
  explicit LibraryDetector(const Options& options);
  LibraryDetector() : LibraryDetector(Options{}) {}
  ~LibraryDetector();
  // As the library gives them, half-pixel corrected, not refined; an id may come several times.
  const std::vector<SeenTag>& Detect(const cv::Mat& gray);

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace intabs
