// Real photographs (../shared/data/apriltag beside the repository; skipped where they are not).
#include <algorithm>
#include <catch2/catch.hpp>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <opencv2/imgcodecs.hpp>
#include <set>
#include <sstream>
#include <string>

#include "intabs/perception/detector.h"

using namespace intabs;

namespace {

const std::filesystem::path kPhotos = std::filesystem::path(INTABS_SOURCE_DIR) / "../shared/data/apriltag";

bool Absent() {
  if (std::filesystem::exists(kPhotos)) return false;
  WARN("skipped: no photographs in " << kPhotos.lexically_normal().string());
  return true;
}

cv::Mat Read(const std::filesystem::path& file) {
  const cv::Mat gray = cv::imread(file.string(), cv::IMREAD_GRAYSCALE);
  REQUIRE(!gray.empty());
  return gray;
}

}  // namespace

TEST_CASE("In photographs every tag that AprilTag finds is found, by its right id, and nothing else") {
  if (Absent()) return;
  std::ifstream list(kPhotos / "photos/groundtruth.txt");
  LibraryDetector library;
  int photos = 0, tags = 0, by_scans = 0;
  for (std::string line; std::getline(list, line); ++photos) {
    std::istringstream words(line);
    std::string name;
    words >> name;
    std::set<int> truth;
    for (int id; words >> id;) truth.insert(id);
    const cv::Mat gray = Read(kPhotos / "photos" / name);
    TagDetector fresh({}), scanning({}, {.budget_px = 400000});
    std::set<int> found, scanned;
    for (const SeenTag& t : fresh.Detect(gray, {}, true)) found.insert(t.id);
    scanning.Detect(cv::Mat(gray.size(), CV_8UC1, cv::Scalar(0)), {}, true);
    for (int i = 0; i < 4; ++i) {  // decimated, and each part of the picture once
      for (const SeenTag& t : scanning.Detect(gray, {}, true)) scanned.insert(t.id);
    }
    INFO(name);
    for (const SeenTag& t : library.Detect(gray)) {
      if (!truth.contains(t.id)) continue;
      INFO("tag " << t.id);
      CHECK(found.contains(t.id));
      ++tags;
      by_scans += scanned.contains(t.id);
    }
    CHECK(std::includes(truth.begin(), truth.end(), found.begin(), found.end()));
    CHECK(std::includes(truth.begin(), truth.end(), scanned.begin(), scanned.end()));
  }
  CHECK(photos == 24);
  CHECK(tags >= 60);
  CHECK(by_scans == tags);
}

TEST_CASE("The library's corners in photographs are the published ones, half a pixel shifted") {
  // Published with the photographs for AprilTag without edge refinement, in its own convention.
  if (Absent()) return;
  LibraryDetector library({.refine_edges = false});
  int n = 0;
  double sum = 0;
  for (const char* name :
       {"33369213973_9d9bb4cc96_c", "34085369442_304b6bafd9_c", "34139872896_defdb2f8d9_c"}) {
    const auto& seen = library.Detect(Read(kPhotos / "corners" / (std::string(name) + ".jpg")));
    std::ifstream list(kPhotos / "corners" / (std::string(name) + ".txt"));
    for (std::string line; std::getline(list, line); ++n) {
      for (char& c : line) {
        if (c == ',' || c == '(' || c == ')') c = ' ';
      }
      std::istringstream numbers(line);
      int id;
      TagCorners expected;
      numbers >> id;
      for (Eigen::Vector2d& c : expected) numbers >> c.x() >> c.y();
      REQUIRE(numbers);
      double best = 1e9, shift = 0;
      for (const SeenTag& t : seen) {
        double worst = 0, mean = 0;
        for (int k = 0; k < 4; ++k) {
          const Eigen::Vector2d d = t.corners[k] + Eigen::Vector2d(.5, .5) - expected[k];
          worst = std::max(worst, d.lpNorm<Eigen::Infinity>());
          mean += (d.x() + d.y()) / 8;
        }
        if (t.id == id && worst < best) {
          best = worst;
          shift = mean;
        }
      }
      INFO(name << ", tag " << id << " at " << expected[0].transpose());
      CHECK(best < .3);
      sum += shift;
    }
  }
  CHECK(n == 47);
  CHECK(std::abs(sum / n) < .02);
}
