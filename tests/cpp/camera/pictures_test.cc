// Video and picture strip.
#include <signal.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <catch2/catch.hpp>
#include <filesystem>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/videoio.hpp>
#include <random>

#include "intabs/camera/strip.h"
#include "intabs/camera/video_writer.h"

namespace intabs {
namespace {

std::vector<uint8_t> Flat(int width, int height, uint8_t r, uint8_t g, uint8_t b) {
  std::vector<uint8_t> rgb(size_t{3} * width * height);
  for (size_t i = 0; i < rgb.size(); i += 3) {
    rgb[i] = r;
    rgb[i + 1] = g;
    rgb[i + 2] = b;
  }
  return rgb;
}

// A folder that goes with its test.
struct Folder {
  Folder() {
    std::filesystem::remove_all(path);
    std::filesystem::create_directory(path);
  }
  ~Folder() { std::filesystem::remove_all(path); }
  const std::string path =
      std::filesystem::temp_directory_path() / ("intabs_pictures_" + std::to_string(getpid()));
};

}  // namespace

TEST_CASE("A written video opens again with its size, rate, frames and colours") {
  const Folder folder;
  const std::string path = folder.path + "/run.mp4";
  VideoWriter video(path, 160, 120, 25);
  for (int i = 0; i < 40; ++i) video.Write(Flat(160, 120, i < 20 ? 200 : 20, 40, i < 20 ? 20 : 200).data());
  video.Close();

  cv::VideoCapture in(path, cv::CAP_FFMPEG);
  REQUIRE(in.isOpened());
  CHECK(in.get(cv::CAP_PROP_FRAME_WIDTH) == 160);
  CHECK(in.get(cv::CAP_PROP_FRAME_HEIGHT) == 120);
  CHECK(in.get(cv::CAP_PROP_FPS) == Approx(25));
  int n = 0;
  cv::Mat bgr;
  for (; in.read(bgr); ++n) {
    const auto pixel = bgr.at<cv::Vec3b>(60, 80);
    CHECK(pixel[n < 20 ? 2 : 0] > 150);
    CHECK(pixel[n < 20 ? 0 : 2] < 80);
  }
  CHECK(n == 40);
}

TEST_CASE("A video that cannot be written is refused in one line with its path") {
  const Folder folder;
  CHECK_THROWS_WITH(VideoWriter(folder.path + "/none/run.mp4", 160, 120, 25),
                    Catch::Contains("none/run.mp4"));
  CHECK_THROWS_WITH(VideoWriter(folder.path + "/run.mp4", 161, 120, 25), Catch::Contains("161x120"));
  CHECK_THROWS_WITH(VideoWriter(folder.path + "/run.mp4", 160, 120, 0), Catch::Contains("rate"));
}

TEST_CASE("A disk that fills up during the video is noticed when it is closed") {
  const Folder folder;
  const pid_t child = fork();
  REQUIRE(child >= 0);
  if (child == 0) {
    signal(SIGXFSZ, SIG_IGN);
    const rlimit limit{20000, 20000};
    setrlimit(RLIMIT_FSIZE, &limit);
    int code = 1;
    try {
      VideoWriter video(folder.path + "/run.mp4", 160, 120, 25);
      std::mt19937 random(1);
      std::vector<uint8_t> rgb(size_t{3} * 160 * 120);
      for (int i = 0; i < 60; ++i) {
        for (uint8_t& v : rgb) v = static_cast<uint8_t>(random());
        video.Write(rgb.data());
      }
      video.Close();
    } catch (const std::runtime_error& e) {
      code = std::string(e.what()).find("run.mp4: holds ") != std::string::npos ? 0 : 2;
    }
    _exit(code);
  }
  int status = 0;
  REQUIRE(waitpid(child, &status, 0) == child);
  REQUIRE(WIFEXITED(status));
  CHECK(WEXITSTATUS(status) == 0);
}

TEST_CASE("The strip shows the first frame, the last, and those between at even distances") {
  const Folder folder;
  const std::string path = folder.path + "/strip.png";
  const int frames = GENERATE(5, 6, 39, 40, 41, 1000, 2017);
  PictureStrip strip(5, 40);
  // The frame's number in red and green.
  for (int i = 0; i < frames; ++i) {
    strip.Add(Flat(80, 60, static_cast<uint8_t>(i / 16), static_cast<uint8_t>(i % 16), 200).data(), 80, 60);
  }
  strip.Save(path);
  const cv::Mat bgr = cv::imread(path);
  REQUIRE(bgr.cols == 5 * 40);
  REQUIRE(bgr.rows == 30);
  CAPTURE(frames);
  for (int k = 0; k < 5; ++k) {
    const auto pixel = bgr.at<cv::Vec3b>(15, 40 * k + 20);
    CHECK(pixel[0] == 200);
    const int shown = 16 * pixel[2] + pixel[1];
    const double wanted = k * (frames - 1) / 4.0;
    CAPTURE(k, shown, wanted);
    CHECK(std::abs(shown - wanted) <= (k % 4 == 0 ? 0 : std::max(0.5, 0.025 * frames)));
  }
}

TEST_CASE("A strip of fewer frames than pictures shows each once; one of none is refused") {
  const Folder folder;
  const std::string path = folder.path + "/strip.png";
  PictureStrip strip(5, 40);
  CHECK_THROWS_WITH(strip.Save(path), Catch::Contains("no pictures"));
  for (int i = 0; i < 3; ++i) strip.Add(Flat(80, 60, static_cast<uint8_t>(50 * i), 0, 0).data(), 80, 60);
  strip.Save(path);
  const cv::Mat bgr = cv::imread(path);
  REQUIRE(bgr.cols == 3 * 40);
  for (int k = 0; k < 3; ++k) CHECK(bgr.at<cv::Vec3b>(15, 40 * k + 20)[2] == 50 * k);
  CHECK_THROWS_WITH(strip.Save(folder.path + "/none/strip.png"), Catch::Contains("none/strip.png"));
}

}  // namespace intabs
