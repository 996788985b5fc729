#include "intabs/camera/strip.h"

#include <algorithm>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <stdexcept>

namespace intabs {
namespace {
constexpr int kKeptPerPicture = 8;
}  // namespace

PictureStrip::PictureStrip(int pictures, int picture_width)
    : pictures_(pictures), picture_width_(picture_width) {
  if (pictures < 2 || picture_width < 1) {
    throw std::runtime_error("a strip of " + std::to_string(pictures) + " pictures of " +
                             std::to_string(picture_width) + " px: it needs at least 2 of 1");
  }
}

void PictureStrip::Add(const uint8_t* rgb, int width, int height) {
  const cv::Mat picture(height, width, CV_8UC3, const_cast<uint8_t*>(rgb));
  cv::Mat small;
  const cv::Size size(picture_width_, std::max(1, (picture_width_ * height + width / 2) / width));
  cv::resize(picture, small, size, 0, 0, cv::INTER_AREA);
  cv::cvtColor(small, last_, cv::COLOR_RGB2BGR);
  if (added_++ % stride_ != 0) return;
  kept_.push_back(last_.clone());
  if (kept_.size() < static_cast<size_t>(kKeptPerPicture) * pictures_) return;
  for (size_t i = 1; 2 * i < kept_.size(); ++i) kept_[i] = kept_[2 * i];
  kept_.resize((kept_.size() + 1) / 2);
  stride_ *= 2;
}

void PictureStrip::Save(const std::string& png) const {
  if (added_ == 0) throw std::runtime_error(png + ": no pictures to make a strip of");
  const int n = static_cast<int>(std::min<int64_t>(pictures_, added_));
  std::vector<cv::Mat> chosen;
  for (int i = 0; i < n - 1; ++i) {
    const double frame = static_cast<double>(i) * static_cast<double>(added_ - 1) / (n - 1);
    const auto k = static_cast<size_t>(frame / static_cast<double>(stride_) + 0.5);
    chosen.push_back(kept_[std::min(k, kept_.size() - 1)]);
  }
  chosen.push_back(last_);
  cv::Mat strip;
  cv::hconcat(chosen, strip);
  bool written = false;
  try {
    written = cv::imwrite(png, strip);
  } catch (const cv::Exception&) {  // an unknown ending
  }
  if (!written)
    throw std::runtime_error(png + ": cannot be written: its folder must exist and its name end in .png");
}

}  // namespace intabs
