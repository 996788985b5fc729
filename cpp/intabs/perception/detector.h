// AprilTag 36h11 in one camera's grey images, at full resolution: where tags are expected, or in the whole
// frame for new and lost ones. The answer depends on the frames given so far, never on time or threads.
#pragma once

#include <memory>
#include <opencv2/core/mat.hpp>
#include <span>
#include <vector>

#include "intabs/perception/reprojection.h"

namespace intabs {

struct SeenTag {
  int id = -1;
  TagCorners corners;  // px, half-pixel corrected, refined (refine.h)
  float decision_margin = 0;
};

class TagDetector {
 public:
  explicit TagDetector(std::vector<int> ids);  // reports these tags; all, when empty
  ~TagDetector();
  TagDetector(TagDetector&&) noexcept;
  TagDetector& operator=(TagDetector&&) noexcept;

  // gray: (H, W) CV_8UC1, at least 16 x 16 (smaller or empty: no tags).
  // expected: where the caller knows of tags to look for, beside those of the last frame.
  // scan: look at the whole frame too. A frame that lacks a tag of the frame before is scanned in any case,
  // so is the first one. Tags come sorted by id, each id at most once. Throws std::runtime_error for an image
  // of another type.
  const std::vector<SeenTag>& Detect(const cv::Mat& gray, std::span<const cv::Rect> expected, bool scan);

  void Reset();  // as new

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace intabs
