#pragma once

#include <cstdint>
#include <opencv2/core/mat.hpp>

namespace intabs {

struct Frame {
  int64_t frame_seq = 0;    // from 1, rising; what is missing between was lost before it came here
  int64_t exposure_us = 0;  // of the source's clock
  cv::Mat rgb;              // (H, W) CV_8UC3, row 0 on top; empty: it came, but cannot be read
  cv::Mat depth;            // (H, W) CV_16UC1, mm along the optical axis, aligned with rgb, 0: nothing there;
                            // empty: none came
};

}  // namespace intabs
