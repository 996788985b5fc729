// A run in one picture: N frames at even distances, side by side. Not real-time safe.
#pragma once

#include <cstdint>
#include <opencv2/core/mat.hpp>
#include <string>
#include <vector>

namespace intabs {

// Memory is bounded however long the run: small copies of at most 8 N frames are kept, every 2^k-th.
class PictureStrip {
 public:
  // pictures >= 2, each `picture_width` px wide.
  PictureStrip(int pictures, int picture_width);

  void Add(const uint8_t* rgb, int width, int height);  // row 0 on top; the same size each time

  // The first frame, the last, and those between at even distances; fewer when fewer were added. Throws
  // std::runtime_error in one line when nothing was added or the file cannot be written.
  void Save(const std::string& png) const;

 private:
  const int pictures_, picture_width_;
  int64_t added_ = 0;
  int64_t stride_ = 1;
  std::vector<cv::Mat> kept_;  // frames 0, stride, 2 stride, ... in BGR
  cv::Mat last_;
};

}  // namespace intabs
