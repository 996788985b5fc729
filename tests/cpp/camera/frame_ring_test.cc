#include "intabs/camera/frame_ring.h"

#include <fcntl.h>
#include <signal.h>
#include <sys/mman.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <catch2/catch.hpp>
#include <chrono>
#include <functional>
#include <thread>

namespace intabs {
namespace {

const std::vector<std::string> kCameras = {"left", "right"};

std::string RingName() {
  static int n = 0;
  return "/intabs_test_" + std::to_string(getpid()) + "_" + std::to_string(n++);
}

std::string ErrorOf(const std::function<void()>& call) {
  try {
    call();
  } catch (const std::runtime_error& e) {
    return e.what();
  }
  return "";
}

bool Exists(const std::string& name) {
  const int fd = shm_open(name.c_str(), O_RDONLY, 0);
  if (fd >= 0) close(fd);
  return fd >= 0;
}

std::vector<uint8_t> Picture(int width, int height, int value) {
  return std::vector<uint8_t>(size_t{3} * width * height, static_cast<uint8_t>(value));
}

}  // namespace

TEST_CASE("What is written into the ring is read from it, camera by camera") {
  const std::string name = RingName();
  FrameRingWriter writer(name, kCameras, 37, 11, 3);  // 1221 bytes: no whole number of words
  const FrameRingReader reader(name);
  CHECK(reader.cameras() == kCameras);
  CHECK(reader.FindCamera("right") == 1);
  CHECK(reader.width() == 37);
  CHECK(reader.height() == 11);
  CHECK(reader.newest_seq() == 0);

  std::vector<uint8_t> rgb = Picture(37, 11, 0);
  for (size_t i = 0; i < rgb.size(); ++i) rgb[i] = static_cast<uint8_t>(i * 7 + i / 251);
  writer.Write(0, 1, 1000, rgb.data());
  CHECK(reader.newest_seq() == 0);  // the other camera's is missing
  const std::vector<uint8_t> other = Picture(37, 11, 99);
  writer.Write(1, 1, 1001, other.data());
  CHECK(reader.newest_seq() == 1);

  Frame frame;
  REQUIRE(reader.Read(1, 0, frame) == FrameRead::kWhole);
  CHECK(frame.frame_seq == 1);
  CHECK(frame.exposure_us == 1000);
  REQUIRE(frame.rgb.rows == 11);
  REQUIRE(frame.rgb.cols == 37);
  CHECK(std::equal(rgb.begin(), rgb.end(), frame.rgb.data));
  REQUIRE(reader.Read(1, 1, frame) == FrameRead::kWhole);
  CHECK(frame.exposure_us == 1001);
  CHECK(std::equal(other.begin(), other.end(), frame.rgb.data));
}

TEST_CASE("A ring with depth gives it beside the colours, one without gives none") {
  const std::string name = RingName();
  FrameRingWriter writer(name, kCameras, 37, 11, 3, true);  // 814 bytes: no whole number of words
  const FrameRingReader reader(name);
  REQUIRE(reader.has_depth());
  std::vector<uint16_t> depth(37 * 11);
  for (size_t i = 0; i < depth.size(); ++i) depth[i] = static_cast<uint16_t>(i * 161);
  for (const int camera : {0, 1}) {  // the slots lie side by side
    for (int seq = 1; seq <= 3; ++seq) {
      depth[0] = static_cast<uint16_t>(10 * camera + seq);
      writer.Write(camera, seq, 1000, Picture(37, 11, 100 + 10 * camera + seq).data(), depth.data());
    }
  }
  Frame frame;
  for (const int camera : {0, 1}) {
    for (int seq = 1; seq <= 3; ++seq) {
      CAPTURE(camera, seq);
      REQUIRE(reader.Read(seq, camera, frame) == FrameRead::kWhole);
      depth[0] = static_cast<uint16_t>(10 * camera + seq);
      REQUIRE(frame.depth.type() == CV_16UC1);
      REQUIRE(frame.depth.size() == cv::Size(37, 11));
      CHECK(std::equal(depth.begin(), depth.end(), frame.depth.ptr<uint16_t>()));
      const std::vector<uint8_t> rgb = Picture(37, 11, 100 + 10 * camera + seq);
      CHECK(std::equal(rgb.begin(), rgb.end(), frame.rgb.data));
    }
  }
  writer.Write(0, 4, 1000, Picture(37, 11, 1).data());  // without depth this time: nothing has one
  REQUIRE(reader.Read(4, 0, frame) == FrameRead::kWhole);
  CHECK(std::all_of(frame.depth.ptr<uint16_t>(), frame.depth.ptr<uint16_t>() + 37 * 11,
                    [](uint16_t v) { return v == 0; }));

  const std::string flat = RingName();
  FrameRingWriter colour(flat, kCameras, 37, 11);
  colour.Write(0, 1, 1000, Picture(37, 11, 1).data(), depth.data());
  const FrameRingReader flat_reader(flat);
  CHECK_FALSE(flat_reader.has_depth());
  REQUIRE(flat_reader.Read(1, 0, frame) == FrameRead::kWhole);
  CHECK(frame.depth.empty());
}

TEST_CASE("Frames that are not written yet, overwritten already, or of no camera are not read") {
  const std::string name = RingName();
  FrameRingWriter writer(name, kCameras, 16, 8, 3);
  const FrameRingReader reader(name);
  Frame frame;
  CHECK(reader.Read(0, 0, frame) == FrameRead::kAbsent);
  CHECK(reader.Read(1, 0, frame) == FrameRead::kAbsent);
  for (int seq = 1; seq <= 4; ++seq) writer.Write(0, seq, seq, Picture(16, 8, seq).data());
  CHECK(reader.Read(1, 0, frame) == FrameRead::kAbsent);  // 4 lies in its slot
  CHECK(reader.Read(2, 0, frame) == FrameRead::kWhole);
  CHECK(reader.Read(4, 0, frame) == FrameRead::kWhole);
  CHECK(frame.rgb.data[0] == 4);
  CHECK(reader.Read(5, 0, frame) == FrameRead::kAbsent);
  CHECK(reader.Read(4, 1, frame) == FrameRead::kAbsent);
  CHECK(reader.Read(4, 2, frame) == FrameRead::kAbsent);
  CHECK(reader.Read(4, -1, frame) == FrameRead::kAbsent);
  CHECK(reader.Read(-2, 0, frame) == FrameRead::kAbsent);
}

TEST_CASE("A frame that is overwritten while it is copied is not taken for a whole one") {
  const std::string name = RingName();
  constexpr int kWidth = 320, kHeight = 240;
  FrameRingWriter writer(name, {"only"}, kWidth, kHeight, 1);
  const FrameRingReader reader(name);
  std::atomic<bool> stop{false};
  std::thread thread([&] {
    std::vector<uint8_t> rgb;
    for (int64_t seq = 1; !stop; ++seq) {
      rgb.assign(size_t{3} * kWidth * kHeight, static_cast<uint8_t>(seq % 251));
      writer.Write(0, seq, 3 * seq, rgb.data());
      std::this_thread::sleep_for(std::chrono::microseconds(100));
    }
  });
  Frame frame;
  int whole = 0, wrong = 0;
  while (whole < 500) {
    const int64_t seq = reader.newest_seq();
    if (reader.Read(seq, 0, frame) != FrameRead::kWhole) continue;
    ++whole;
    const uint8_t* end = frame.rgb.data + size_t{3} * kWidth * kHeight;
    const bool same =
        std::all_of<const uint8_t*>(frame.rgb.data, end, [&](uint8_t v) { return v == seq % 251; });
    if (!same || frame.frame_seq != seq || frame.exposure_us != 3 * seq) ++wrong;
  }
  stop = true;
  thread.join();
  CHECK(wrong == 0);
}

TEST_CASE("A frame that its writer has begun and not ended is torn, not whole") {
  const std::string name = RingName();
  FrameRingWriter writer(name, {"only"}, 16, 8, 2);
  const FrameRingReader reader(name);
  writer.Write(0, 3, 1, Picture(16, 8, 5).data());
  Frame frame;
  REQUIRE(reader.Read(3, 0, frame) == FrameRead::kWhole);
  const int fd = shm_open(name.c_str(), O_RDWR, 0);
  REQUIRE(fd >= 0);
  const off_t version = 256 + 64 * (3 % 2);  // the header, then a slot a frame
  int64_t value = 0;
  REQUIRE(pread(fd, &value, sizeof(value), version) == sizeof(value));
  REQUIRE(value == 2);
  value = 3;
  REQUIRE(pwrite(fd, &value, sizeof(value), version) == sizeof(value));
  close(fd);
  CHECK(reader.Read(3, 0, frame) == FrameRead::kTorn);
}

TEST_CASE("Without a ring the reader says so in one line") {
  const std::string name = RingName();
  const std::string error = ErrorOf([&] { FrameRingReader reader(name); });
  CHECK_THAT(error, Catch::Contains(name) && Catch::Contains("there is none"));
  CHECK(error.find('\n') == std::string::npos);
}

TEST_CASE("The ring goes with its writer; a reader that has it keeps the last frames") {
  const std::string name = RingName();
  auto writer = std::make_unique<FrameRingWriter>(name, kCameras, 16, 8);
  const FrameRingReader reader(name);
  writer->Write(0, 1, 1, Picture(16, 8, 5).data());
  writer.reset();
  CHECK_FALSE(Exists(name));
  Frame frame;
  CHECK(reader.Read(1, 0, frame) == FrameRead::kWhole);
}

TEST_CASE("A killed writer's ring is replaced; that of a running one is not") {
  const std::string name = RingName();
  int pipe_fds[2];
  REQUIRE(pipe(pipe_fds) == 0);
  const pid_t child = fork();
  REQUIRE(child >= 0);
  if (child == 0) {
    const FrameRingWriter* writer = new FrameRingWriter(name, {"old"}, 64, 48, 2);
    const char ready = writer != nullptr;
    if (write(pipe_fds[1], &ready, 1) == 1) pause();
    _exit(1);
  }
  char ready = 0;
  REQUIRE(read(pipe_fds[0], &ready, 1) == 1);
  close(pipe_fds[0]);
  close(pipe_fds[1]);

  CHECK_THAT(ErrorOf([&] { FrameRingWriter second(name, kCameras, 16, 8); }),
             Catch::Contains(name) && Catch::Contains("another process writes it"));
  CHECK(FrameRingReader(name).width() == 64);

  REQUIRE(kill(child, SIGKILL) == 0);
  int status = 0;
  REQUIRE(waitpid(child, &status, 0) == child);
  REQUIRE(WIFSIGNALED(status));
  REQUIRE(Exists(name));
  {
    FrameRingWriter writer(name, kCameras, 16, 8);
    writer.Write(0, 1, 1, Picture(16, 8, 5).data());
    const FrameRingReader reader(name);
    CHECK(reader.width() == 16);
    Frame frame;
    CHECK(reader.Read(1, 0, frame) == FrameRead::kWhole);
  }
  CHECK_FALSE(Exists(name));
}

TEST_CASE("Shared memory that is no ring is refused by the reader and replaced by the writer") {
  const std::string name = RingName();
  const int fd = shm_open(name.c_str(), O_CREAT | O_RDWR, 0600);
  REQUIRE(fd >= 0);
  const int size = GENERATE(0, 5, 100000);
  REQUIRE(ftruncate(fd, size) == 0);
  close(fd);
  CHECK_THAT(ErrorOf([&] { FrameRingReader reader(name); }),
             Catch::Contains(name) && Catch::Contains("not (yet) a ring"));
  FrameRingWriter writer(name, kCameras, 16, 8);
  CHECK(FrameRingReader(name).width() == 16);
}

TEST_CASE("A ring that cannot be is refused in one line that names what is wrong") {
  const std::string name = RingName();
  const auto refusal = [&](const std::vector<std::string>& cameras, int width, int height, int slots) {
    const std::string error = ErrorOf([&] { FrameRingWriter writer(name, cameras, width, height, slots); });
    CHECK(error.find('\n') == std::string::npos);
    CHECK_FALSE(Exists(name));
    return error;
  };
  CHECK_THAT(refusal({}, 16, 8, 2), Catch::Contains("0 cameras"));
  CHECK_THAT(refusal({"a", "b", "c", "d", "e"}, 16, 8, 2), Catch::Contains("5 cameras"));
  CHECK_THAT(refusal({std::string(32, 'x')}, 16, 8, 2), Catch::Contains("xxx"));
  CHECK_THAT(refusal({"a"}, 0, 8, 2), Catch::Contains("0x8"));
  CHECK_THAT(refusal({"a"}, 16, 8, 0), Catch::Contains("0 slots"));
  CHECK_THAT(refusal({"a"}, 8000, 8000, 1024), Catch::Contains("/dev/shm"));
  CHECK_THAT(ErrorOf([] { FrameRingWriter writer("/a/b", kCameras, 16, 8); }), Catch::Contains("/a/b"));
}

}  // namespace intabs
