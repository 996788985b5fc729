// Writes an mp4. Not real-time safe.
#pragma once

#include <cstdint>
#include <memory>
#include <string>

namespace intabs {

class VideoWriter {
 public:
  // H.264 where OpenCV's ffmpeg has an encoder for it, else MPEG-4 part 2. Width and height must be even.
  // Throws std::runtime_error in one line when the file cannot be written.
  VideoWriter(const std::string& path, int width, int height, double fps);
  ~VideoWriter();  // closes without looking at what came of it
  VideoWriter(const VideoWriter&) = delete;
  VideoWriter& operator=(const VideoWriter&) = delete;

  void Write(const uint8_t* rgb);  // H * W * 3, row 0 on top

  // Finishes the file and opens it again: throws when it does not hold all frames (a full disk shows only
  // here).
  void Close();

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace intabs
