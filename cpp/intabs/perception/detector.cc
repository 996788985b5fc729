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
// Standard deviation of the coordinates of corners that could not be refined (hidden in part, smeared) [px].
constexpr double kUnrefined = 0.5;
// Around a tag of the last frame: 0.5 m/s at 0.6 m is 20 px a frame at 25 Hz.
constexpr int kMargin = 24;
// Whole frames are looked at this much smaller.
constexpr int kDecimate = 2;
constexpr int kBands = 4;         // ... and in so many parts at full resolution, one a scan
constexpr int kBandOverlap = 64;  // px, so that no tag is cut by all bands

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

void CheckType(const cv::Mat& gray) {
  if (gray.type() == CV_8UC1) return;
  throw std::runtime_error("tag detector: the image is of OpenCV type " + std::to_string(gray.type()) +
                           ", give 8-bit grey (CV_8UC1)");
}

// As the library gives it, but for the half pixel. `at`: of the region that it looked at.
SeenTag ToSeen(const apriltag_detection_t& d, cv::Point at) {
  SeenTag tag;
  tag.id = d.id;
  tag.decision_margin = d.decision_margin;
  for (int k = 0; k < 4; ++k) tag.corners[k] = {d.p[k][0] - kHalfPixel + at.x, d.p[k][1] - kHalfPixel + at.y};
  return tag;
}

// The same tag found twice, in a region and by a scan: refined once.
bool Near(const SeenTag& a, const SeenTag& b) {
  for (int k = 0; k < 4; ++k) {
    if (!((a.corners[k] - b.corners[k]).norm() < 3)) return false;
  }
  return true;
}

void SortById(std::vector<SeenTag>& tags) {
  std::sort(tags.begin(), tags.end(), [](const SeenTag& a, const SeenTag& b) { return a.id < b.id; });
}

}  // namespace

struct TagDetector::Impl {
  std::vector<int> ids;
  DetectorOptions options;
  apriltag_family_t* family = tag36h11_create();
  apriltag_detector_t* detector = apriltag_detector_create();
  std::map<int, TagPattern> patterns;
  bool first = true;
  int64_t cost_px = 0;      // of this frame
  size_t first_region = 0;  // where a frame that cannot afford all regions begins
  int band = 0;
  std::vector<SeenTag> seen;
  std::vector<SeenTag> last;

  Impl(std::vector<int> ids_in, const DetectorOptions& options_in)
      : ids(std::move(ids_in)), options(options_in) {
    apriltag_detector_add_family_bits(detector, family, kMaxHamming);
    detector->nthreads = options.threads;
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

  bool Affords(int64_t px) const { return options.budget_px == 0 || cost_px + px <= options.budget_px; }

  // Adds the tags found in one region of the image to `seen`.
  void Search(const cv::Mat& gray, cv::Rect region, int decimate = 1) {
    region &= cv::Rect(0, 0, gray.cols, gray.rows);
    if (region.width < 16 || region.height < 16) return;
    cost_px += static_cast<int64_t>(region.area()) / (decimate * decimate);
    detector->quad_decimate = static_cast<float>(decimate);
    const cv::Mat part = gray(region);
    image_u8_t view = {part.cols, part.rows, static_cast<int32_t>(part.step), part.data};
    zarray_t* found = apriltag_detector_detect(detector, &view);
    for (int i = 0; i < zarray_size(found); ++i) {
      apriltag_detection_t* d;
      zarray_get(found, i, &d);
      if (d->decision_margin < kMinDecisionMargin) continue;
      if (!ids.empty() && std::find(ids.begin(), ids.end(), d->id) == ids.end()) continue;
      SeenTag tag = ToSeen(*d, region.tl());
      const auto same =
          std::find_if(seen.begin(), seen.end(), [&](const SeenTag& t) { return t.id == tag.id; });
      if (same != seen.end() && (same->decision_margin >= tag.decision_margin || Near(*same, tag))) continue;
      if (!RefineCorners(gray, Pattern(tag.id), tag.corners, &tag.covariance)) {
        tag.covariance = kUnrefined * kUnrefined * Matrix8d::Identity();
      }
      if (same == seen.end()) {
        seen.push_back(tag);
      } else {
        *same = tag;
      }
    }
    apriltag_detections_destroy(found);
  }

  bool Lost() const {
    return !std::all_of(last.begin(), last.end(), [&](const SeenTag& tag) {
      return std::any_of(seen.begin(), seen.end(), [&](const SeenTag& t) { return t.id == tag.id; });
    });
  }
};

TagDetector::TagDetector(std::vector<int> ids, const DetectorOptions& options)
    : impl_(std::make_unique<Impl>(std::move(ids), options)) {}
TagDetector::~TagDetector() = default;
TagDetector::TagDetector(TagDetector&&) noexcept = default;
TagDetector& TagDetector::operator=(TagDetector&&) noexcept = default;

const std::vector<SeenTag>& TagDetector::Detect(const cv::Mat& gray, std::span<const cv::Rect> expected,
                                                bool scan) {
  Impl& s = *impl_;
  s.last.swap(s.seen);
  s.seen.clear();
  s.cost_px = 0;
  if (gray.empty()) return s.seen;
  CheckType(gray);
  const cv::Rect whole(0, 0, gray.cols, gray.rows);
  if (s.first) {
    s.first = false;
    s.Search(gray, whole);
    SortById(s.seen);
    return s.seen;
  }

  std::vector<cv::Rect> regions;
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
  size_t looked_at = 0;
  for (; looked_at < regions.size(); ++looked_at) {
    const cv::Rect& r = regions[(s.first_region + looked_at) % regions.size()];
    if (!s.Affords(r.area()) && looked_at > 0) break;
    s.Search(gray, r);
  }
  s.first_region = looked_at < regions.size() ? s.first_region + looked_at : 0;

  if (looked_at == regions.size() && (scan || s.Lost())) {
    const bool unbounded = s.options.budget_px == 0;
    if (!unbounded && s.Affords(whole.area() / (kDecimate * kDecimate))) s.Search(gray, whole, kDecimate);
    if (unbounded || (s.Lost() && s.Affords(whole.area()))) {
      s.Search(gray, whole);
    } else if (scan) {
      const int height = gray.rows / kBands;
      const cv::Rect band(0, s.band * height - kBandOverlap / 2, gray.cols, height + kBandOverlap);
      if (s.Affords((band & whole).area())) {
        s.Search(gray, band);
        s.band = (s.band + 1) % kBands;
      }
    }
  }
  SortById(s.seen);
  return s.seen;
}

void TagDetector::Reset() {
  impl_->first = true;
  impl_->first_region = 0;
  impl_->band = 0;
  impl_->seen.clear();
}

struct LibraryDetector::Impl {
  apriltag_family_t* family = tag36h11_create();
  apriltag_detector_t* detector = apriltag_detector_create();
  std::vector<SeenTag> seen;

  Impl() {
    apriltag_detector_add_family(detector, family);
    detector->nthreads = 1;
    detector->quad_decimate = 1;
  }
  ~Impl() {
    apriltag_detector_destroy(detector);
    tag36h11_destroy(family);
  }
};

LibraryDetector::LibraryDetector(const Options& options) : impl_(std::make_unique<Impl>()) {
  impl_->detector->refine_edges = options.refine_edges;
}
LibraryDetector::~LibraryDetector() = default;

const std::vector<SeenTag>& LibraryDetector::Detect(const cv::Mat& gray) {
  CheckType(gray);
  impl_->seen.clear();
  image_u8_t view = {gray.cols, gray.rows, static_cast<int32_t>(gray.step), gray.data};
  zarray_t* found = apriltag_detector_detect(impl_->detector, &view);
  for (int i = 0; i < zarray_size(found); ++i) {
    apriltag_detection_t* d;
    zarray_get(found, i, &d);
    impl_->seen.push_back(ToSeen(*d, {0, 0}));
  }
  apriltag_detections_destroy(found);
  return impl_->seen;
}

}  // namespace intabs
