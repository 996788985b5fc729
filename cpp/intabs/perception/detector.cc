#include "intabs/perception/detector.h"

extern "C" {
#include <apriltag/apriltag.h>
#include <apriltag/tag36h11.h>
}

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <map>
#include <stdexcept>
#include <string>

#include "intabs/perception/refine.h"

namespace intabs {
namespace {

// AprilTag counts from the corner of the top left pixel, OpenCV from its centre.
constexpr double kHalfPixel = 0.5;
// Two wrong bits of 36 may be mended; beyond that clutter starts to look like tags.
constexpr int kMaxHamming = 1;
constexpr float kMinDecisionMargin = 20;
// Around a tag of the last frame: 0.5 m/s at 0.6 m is 20 px a frame at 25 Hz.
constexpr int kMargin = 24;

cv::Rect Around(const TagCorners& corners) {
  Eigen::Vector2d lo = corners[0], hi = corners[0];
  for (const Eigen::Vector2d& c : corners) {
    lo = lo.cwiseMin(c);
    hi = hi.cwiseMax(c);
  }
  const double margin = kMargin + 0.25 * (hi - lo).maxCoeff();  // a white border belongs to the tag
  const cv::Point from(std::floor(lo.x() - margin), std::floor(lo.y() - margin));
  const cv::Point to(std::ceil(hi.x() + margin), std::ceil(hi.y() + margin));
  return {from, to};
}

bool Inside(const TagCorners& corners, const cv::Rect& r) {
  return std::all_of(corners.begin(), corners.end(),
                     [&](const Eigen::Vector2d& c) { return r.contains(cv::Point(c.x(), c.y())); });
}

// Overlapping regions become one, so that no pixel is looked at twice and no tag is cut.
void Merge(std::vector<cv::Rect>& regions) {
  for (size_t i = 0; i < regions.size(); ++i) {
    for (size_t j = i + 1; j < regions.size(); ++j) {
      if ((regions[i] & regions[j]).empty()) continue;
      regions[i] |= regions[j];
      regions.erase(regions.begin() + j);
      j = i;  // the grown region may touch those already passed
    }
  }
}

}  // namespace

struct TagDetector::Impl {
  std::vector<int> ids;
  apriltag_family_t* family = tag36h11_create();
  apriltag_detector_t* detector = apriltag_detector_create();
  std::map<int, TagPattern> patterns;
  bool first = true;
  std::vector<SeenTag> seen;
  std::vector<SeenTag> last;

  explicit Impl(std::vector<int> ids_in) : ids(std::move(ids_in)) {
    apriltag_detector_add_family_bits(detector, family, kMaxHamming);
    detector->nthreads = 1;
    detector->quad_decimate = 1;
  }
  ~Impl() {
    apriltag_detector_destroy(detector);
    tag36h11_destroy(family);
  }

  const TagPattern& Pattern(int id) {
    const auto [at, is_new] = patterns.try_emplace(id);
    if (is_new) {
      image_u8_t* image = apriltag_to_image(family, id);
      for (int k = 0; k < 100; ++k) at->second[k] = image->buf[k / 10 * image->stride + k % 10] > 127;
      std::free(image->buf);
      std::free(image);
    }
    return at->second;
  }

  // Adds the tags found in one region of the image to `out`.
  void Search(const cv::Mat& gray, cv::Rect region, std::vector<SeenTag>& out) {
    region &= cv::Rect(0, 0, gray.cols, gray.rows);
    if (region.width < 16 || region.height < 16) return;
    const cv::Mat part = gray(region);
    image_u8_t view = {part.cols, part.rows, static_cast<int32_t>(part.step), part.data};
    zarray_t* found = apriltag_detector_detect(detector, &view);
    for (int i = 0; i < zarray_size(found); ++i) {
      apriltag_detection_t* d;
      zarray_get(found, i, &d);
      if (d->decision_margin < kMinDecisionMargin) continue;
      if (!ids.empty() && std::find(ids.begin(), ids.end(), d->id) == ids.end()) continue;
      SeenTag tag;
      tag.id = d->id;
      tag.decision_margin = d->decision_margin;
      for (int k = 0; k < 4; ++k) {
        tag.corners[k] = {d->p[k][0] - kHalfPixel + region.x, d->p[k][1] - kHalfPixel + region.y};
      }
      RefineCorners(gray, Pattern(tag.id), tag.corners);
      const auto same =
          std::find_if(out.begin(), out.end(), [&](const SeenTag& t) { return t.id == tag.id; });
      if (same == out.end()) {
        out.push_back(tag);
      } else if (same->decision_margin < tag.decision_margin) {
        *same = tag;
      }
    }
    apriltag_detections_destroy(found);
  }
};

TagDetector::TagDetector(std::vector<int> ids) : impl_(std::make_unique<Impl>(std::move(ids))) {}
TagDetector::~TagDetector() = default;
TagDetector::TagDetector(TagDetector&&) noexcept = default;
TagDetector& TagDetector::operator=(TagDetector&&) noexcept = default;

const std::vector<SeenTag>& TagDetector::Detect(const cv::Mat& gray, std::span<const cv::Rect> expected,
                                                bool scan) {
  Impl& s = *impl_;
  s.last.swap(s.seen);
  s.seen.clear();
  if (gray.empty()) return s.seen;
  if (gray.type() != CV_8UC1) {
    throw std::runtime_error("tag detector: the image is of OpenCV type " + std::to_string(gray.type()) +
                             ", give 8-bit grey (CV_8UC1)");
  }
  const cv::Rect whole(0, 0, gray.cols, gray.rows);
  std::vector<cv::Rect> regions;
  if (s.first || scan) {
    regions.push_back(whole);
  } else {
    for (const cv::Rect& r : expected) {
      if (!(r & whole).empty()) regions.push_back(r & whole);
    }
    const size_t n_expected = regions.size();
    for (const SeenTag& tag : s.last) {
      const bool covered = std::any_of(regions.begin(), regions.begin() + n_expected,
                                       [&](const cv::Rect& r) { return Inside(tag.corners, r); });
      if (!covered) regions.push_back(Around(tag.corners) & whole);
    }
    Merge(regions);
  }
  s.first = false;
  for (const cv::Rect& r : regions) s.Search(gray, r, s.seen);

  const auto is_seen = [&](const SeenTag& tag) {
    return std::any_of(s.seen.begin(), s.seen.end(), [&](const SeenTag& t) { return t.id == tag.id; });
  };
  const bool lost = !std::all_of(s.last.begin(), s.last.end(), is_seen);
  if (lost && !scan) {
    s.seen.clear();
    s.Search(gray, whole, s.seen);
  }
  std::sort(s.seen.begin(), s.seen.end(), [](const SeenTag& a, const SeenTag& b) { return a.id < b.id; });
  return s.seen;
}

void TagDetector::Reset() {
  impl_->first = true;
  impl_->seen.clear();
}

}  // namespace intabs
