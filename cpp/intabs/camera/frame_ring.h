// Colour frames, with depth where the writer has it, from one writing process to any number of reading ones,
// through POSIX shared memory: a ring of slots a camera, each under a seqlock. The writer never waits; a
// reader that comes too late is told so.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "intabs/camera/frame.h"
#include "intabs/core/types.h"

namespace intabs {

enum class FrameRead {
  kWhole,
  kAbsent,  // not written yet, or overwritten already
  kTorn,    // is being written, or was overwritten during the copy
};

// One thread. Set-up throws std::runtime_error in one line.
class FrameRingWriter {
 public:
  static constexpr int kDefaultSlots = 8;

  // name: as in shm_open, "/intabs_frames". What a killed writer left under it is replaced; the ring of one
  // that still runs is not: throws. At most kMaxCameras cameras with names of at most 31 bytes.
  // depth: pictures have a depth plane.
  FrameRingWriter(const std::string& name, const std::vector<std::string>& cameras, int width, int height,
                  int slots = kDefaultSlots, bool depth = false);
  ~FrameRingWriter();  // takes the name away; readers keep what they have mapped
  FrameRingWriter(const FrameRingWriter&) = delete;
  FrameRingWriter& operator=(const FrameRingWriter&) = delete;

  // rgb: H * W * 3. frame_seq > 0 and rising; every camera gets every frame. depth: H * W (Frame::depth), in
  // a ring that has it; nullptr: nothing has a depth. No allocation, no lock, no system call.
  void Write(int camera, int64_t frame_seq, int64_t exposure_us, const uint8_t* rgb,
             const uint16_t* depth = nullptr) noexcept;

 private:
  struct Map;
  std::unique_ptr<Map> map_;
};

// One thread an object.
class FrameRingReader {
 public:
  // Throws std::runtime_error in one line when there is no such ring.
  // A ring outlives its writer in a reader's hands and then just gets no new frames: to follow a new writer
  // of the same name, make a new reader.
  explicit FrameRingReader(const std::string& name);
  ~FrameRingReader();
  FrameRingReader(const FrameRingReader&) = delete;
  FrameRingReader& operator=(const FrameRingReader&) = delete;

  const std::vector<std::string>& cameras() const { return cameras_; }
  int FindCamera(const std::string& name) const;  // throws and lists the known ones
  int width() const;
  int height() const;
  bool has_depth() const;

  // The newest frame that all cameras have; 0: none yet.
  int64_t newest_seq() const noexcept;

  // Copies that frame out; reuses out's memory. `out` holds nothing of use unless it is whole.
  FrameRead Read(int64_t frame_seq, int camera, Frame& out) const;

  // Whether the name still leads to this ring: false when its writer took it away, or another one came.
  bool current() const noexcept;

 private:
  struct Map;
  std::unique_ptr<Map> map_;
  std::vector<std::string> cameras_;
};

}  // namespace intabs
