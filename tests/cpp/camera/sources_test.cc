// Frames from rings that come and go, folders and videos.
#include <unistd.h>

#include <atomic>
#include <catch2/catch.hpp>
#include <chrono>
#include <filesystem>
#include <fstream>
#include <opencv2/imgcodecs.hpp>
#include <thread>

#include "intabs/camera/frame_ring.h"
#include "intabs/camera/frame_source.h"
#include "intabs/camera/grabber.h"
#include "intabs/camera/video_writer.h"

namespace intabs {
namespace {

namespace fs = std::filesystem;

constexpr int kWidth = 64, kHeight = 48;
const CameraRequest kLeft{"left", kWidth, kHeight};

struct Folder {
  Folder() { fs::create_directories(path); }
  ~Folder() { fs::remove_all(path); }
  const std::string path = fs::temp_directory_path() / ("intabs_sources_" + std::to_string(getpid()));
};

std::string RingName() {
  static int n = 0;
  return "/intabs_sources_" + std::to_string(getpid()) + "_" + std::to_string(n++);
}

std::vector<uint8_t> Flat(int value) {
  return std::vector<uint8_t>(3 * kWidth * kHeight, static_cast<uint8_t>(value));
}

void Silent(const std::string&) {}

std::string RefusalOf(const std::string& spec, const CameraRequest& camera = kLeft) {
  try {
    const auto source = OpenSource(spec, camera, Silent);
    Frame frame;
    while (source->Next(frame) == Grab::kFrame) {
    }
  } catch (const std::runtime_error& e) {
    CHECK(std::string(e.what()).find('\n') == std::string::npos);
    return e.what();
  }
  return "accepted";
}

}  // namespace

TEST_CASE("A folder gives its pictures by name, 40 ms apart or at the times that the names tell, then ends") {
  const Folder folder;
  const bool stamped = GENERATE(false, true);
  const std::vector<std::string> names =
      stamped
          ? std::vector<std::string>{"1700000000000000.png", "1700000000033000.png", "1700000000066500.png"}
          : std::vector<std::string>{"0001.png", "0002.png", "0010.png"};
  for (size_t i = names.size(); i-- > 0;) {
    cv::Mat bgr(kHeight, kWidth, CV_8UC3, cv::Scalar(10, 20, 50 + 10. * static_cast<double>(i)));
    cv::imwrite(folder.path + "/" + names[i], bgr);
  }
  std::ofstream(folder.path + "/notes.txt") << "no picture";
  const auto source = OpenSource("folder:" + folder.path, kLeft, Silent);
  Frame frame;
  for (int i = 0; i < 3; ++i) {
    REQUIRE(source->Next(frame) == Grab::kFrame);
    CHECK(frame.frame_seq == i + 1);
    CHECK(frame.exposure_us == (stamped ? std::stoll(names[i]) : 40000 * (i + 1)));
    CHECK(frame.rgb.at<cv::Vec3b>(5, 5) == cv::Vec3b(static_cast<uint8_t>(50 + 10 * i), 20, 10));
  }
  CHECK(source->Next(frame) == Grab::kEnd);
  CHECK(source->Next(frame) == Grab::kEnd);
}

TEST_CASE("A folder of colour and depth pictures gives both, those of one name together") {
  const Folder folder;
  const bool wanted = GENERATE(true, false);
  for (int i = 0; i < 3; ++i) {
    const std::string name = folder.path + "/" + std::to_string(790154000 + 40000 * i);
    cv::imwrite(name + "_o.png", cv::Mat(kHeight, kWidth, CV_8UC3, cv::Scalar(10, 20, 30 + i)));
    if (i != 1) cv::imwrite(name + "_depth.png", cv::Mat(kHeight, kWidth, CV_16UC1, cv::Scalar(500 + i)));
  }
  CameraRequest camera = kLeft;
  camera.depth = wanted;
  const auto source = OpenSource("folder:" + folder.path, camera, Silent);
  Frame frame;
  for (int i = 0; i < 3; ++i) {
    CAPTURE(i, wanted);
    REQUIRE(source->Next(frame) == Grab::kFrame);
    CHECK(frame.exposure_us == 790154000 + 40000 * i);
    CHECK(frame.rgb.at<cv::Vec3b>(5, 5)[0] == 30 + i);
    REQUIRE(frame.depth.empty() == (i == 1 || !wanted));
    if (!frame.depth.empty()) CHECK(frame.depth.at<uint16_t>(5, 5) == 500 + i);
  }
  CHECK(source->Next(frame) == Grab::kEnd);
  cv::imwrite(folder.path + "/790154000_depth.png", cv::Mat(kHeight, kWidth, CV_8UC1, cv::Scalar(9)));
  if (wanted) CHECK_THAT(RefusalOf("folder:" + folder.path, camera), Catch::Contains("must have 16 bits"));
}

TEST_CASE("A picture of a folder that cannot be read comes as an empty frame, the others as they are") {
  const Folder folder;
  for (const char* name : {"1.png", "2.png", "3.png"})
    cv::imwrite(folder.path + "/" + name, cv::Mat(kHeight, kWidth, CV_8UC3, cv::Scalar(9, 9, 9)));
  fs::resize_file(folder.path + "/2.png", 30);
  const auto source = OpenSource("folder:" + folder.path, kLeft, Silent);
  Frame frame;
  for (const bool whole : {true, false, true}) {
    REQUIRE(source->Next(frame) == Grab::kFrame);
    CHECK(frame.rgb.empty() == !whole);
  }
}

TEST_CASE("A video gives all its frames at its rate, then ends") {
  const Folder folder;
  const std::string path = folder.path + "/run.mp4";
  VideoWriter video(path, kWidth, kHeight, 30);
  for (int i = 0; i < 20; ++i) video.Write(Flat(10 + 10 * i).data());
  video.Close();
  const auto source = OpenSource("video:" + path, kLeft, Silent);
  Frame frame;
  int n = 0;
  for (; source->Next(frame) == Grab::kFrame; ++n) {
    CHECK(std::abs(frame.rgb.at<cv::Vec3b>(20, 20)[0] - (10 + 10 * n)) < 12);
    CHECK(frame.exposure_us == Approx((n + 1) * 1e6 / 30).margin(1));
  }
  CHECK(n == 20);
}

TEST_CASE("A ring that is taken away is lost, looked for, and followed again when it is back") {
  const std::string name = RingName();
  auto writer =
      std::make_unique<FrameRingWriter>(name, std::vector<std::string>{"right", "left"}, kWidth, kHeight);
  writer->Write(0, 1, 1000, Flat(1).data());
  writer->Write(1, 1, 1000, Flat(1).data());
  std::vector<std::string> said;
  const auto source = OpenSource("ring:" + name, kLeft, [&](const std::string& s) { said.push_back(s); });
  Frame frame;
  CHECK(source->Next(frame) == Grab::kNone);  // what lay there before may be old
  writer->Write(0, 2, 2000, Flat(2).data());
  writer->Write(1, 2, 2001, Flat(3).data());
  REQUIRE(source->Next(frame) == Grab::kFrame);
  CHECK(frame.frame_seq == 2);
  CHECK(frame.exposure_us == 2001);
  CHECK(frame.rgb.data[0] == 3);

  writer.reset();
  const auto next_until = [&](Grab wanted) {
    for (int i = 0; i < 600; ++i) {
      if (source->Next(frame) == wanted) return true;
    }
    return false;
  };
  REQUIRE(next_until(Grab::kLost));
  REQUIRE(said.size() == 1);
  CHECK_THAT(said[0],
             Catch::Contains("camera left") && Catch::Contains(name) && Catch::Contains("looked for"));
  for (int i = 0; i < 5; ++i) CHECK(source->Next(frame) == Grab::kLost);

  writer = std::make_unique<FrameRingWriter>(name, std::vector<std::string>{"left"}, kWidth, kHeight);
  REQUIRE(next_until(Grab::kNone));
  writer->Write(0, 1, 5, Flat(7).data());
  REQUIRE(source->Next(frame) == Grab::kFrame);
  CHECK(frame.exposure_us == 5);
  CHECK(frame.rgb.data[0] == 7);
  REQUIRE(said.size() == 2);
  CHECK(said[1] == "camera left is back");
}

TEST_CASE("A camera that comes back with pictures of another size stays lost") {
  const std::string name = RingName();
  auto writer = std::make_unique<FrameRingWriter>(name, std::vector<std::string>{"left"}, kWidth, kHeight);
  const auto source = OpenSource("ring:" + name, kLeft, Silent);
  writer.reset();
  writer = std::make_unique<FrameRingWriter>(name, std::vector<std::string>{"left"}, kWidth, kHeight / 2);
  Frame frame;
  Grab grab = Grab::kNone;
  for (int i = 0; i < 100 && grab != Grab::kLost; ++i) grab = source->Next(frame);
  REQUIRE(grab == Grab::kLost);
  for (int i = 0; i < 10; ++i) CHECK(source->Next(frame) == Grab::kLost);
}

TEST_CASE("A grabber keeps the newest frame and tells what went by through its number") {
  const std::string name = RingName();
  FrameRingWriter writer(name, {"left"}, kWidth, kHeight);
  std::atomic<int> woken{0};
  Grabber grabber(OpenSource("ring:" + name, kLeft, Silent), [&] { ++woken; });
  Frame frame;
  CHECK_FALSE(grabber.Take(frame));
  for (int i = 1; i <= 5; ++i) {
    const int before = woken;
    writer.Write(0, i, i, Flat(i).data());
    while (woken == before) std::this_thread::sleep_for(std::chrono::milliseconds(1));
  }
  REQUIRE(grabber.Take(frame));
  CHECK(frame.frame_seq == 5);
  CHECK(frame.rgb.data[0] == 5);
  CHECK_FALSE(grabber.Take(frame));
  CHECK_FALSE(grabber.lost());
}

TEST_CASE("A source that is none is refused in one line that names it") {
  const Folder folder;
  CHECK_THAT(RefusalOf("webcam"), Catch::Contains("\"webcam\"") && Catch::Contains("v4l2:DEVICE"));
  CHECK_THAT(RefusalOf("video:"), Catch::Contains("video:FILE"));
  CHECK_THAT(RefusalOf("ring:/intabs_none"), Catch::Contains("/intabs_none"));
  CHECK_THAT(RefusalOf("folder:" + folder.path), Catch::Contains("no pictures"));
  CHECK_THAT(RefusalOf("folder:/nowhere"), Catch::Contains("/nowhere"));
  CHECK_THAT(RefusalOf("video:" + folder.path + "/none.mp4"), Catch::Contains("none.mp4"));
  CHECK_THAT(RefusalOf("v4l2:/dev/video77"), Catch::Contains("/dev/video77"));
  std::ofstream(folder.path + "/no_camera") << "text";
  CHECK_THAT(RefusalOf("v4l2:" + folder.path + "/no_camera"), Catch::Contains("no_camera cannot be opened"));
  CHECK_THAT(RefusalOf("video:" + folder.path + "/no_camera"), Catch::Contains("no_camera"));
  cv::imwrite(folder.path + "/1.png", cv::Mat(kHeight, kWidth + 2, CV_8UC3, cv::Scalar(9, 9, 9)));
  CHECK_THAT(RefusalOf("folder:" + folder.path),
             Catch::Contains("66 x 48") && Catch::Contains("64 x 48") && Catch::Contains("camera left"));
  const std::string name = RingName();
  FrameRingWriter writer(name, {"left"}, kWidth + 2, kHeight);
  CHECK_THAT(RefusalOf("ring:" + name), Catch::Contains("66 x 48"));
  CHECK_THAT(RefusalOf("ring:" + name, {"top", kWidth, kHeight}), Catch::Contains("top"));
}

}  // namespace intabs
