// Frames of one camera, wherever they come from.
#pragma once

#include <functional>
#include <memory>
#include <string>

#include "intabs/camera/frame.h"

namespace intabs {

enum class Grab {
  kFrame,  // a new one
  kNone,   // none yet
  kLost,   // the camera is away; it is being looked for
  kEnd,    // a recording is over
};

// One thread at a time. Not real-time safe.
class FrameSource {
 public:
  virtual ~FrameSource() = default;

  // Waits for the next frame, a live camera's newest, a fraction of a second or until the camera gives up.
  // Reuses out's memory. Throws std::runtime_error in one line where reading breaks down for good.
  virtual Grab Next(Frame& out) = 0;
};

struct CameraRequest {
  std::string name;           // in messages, and in a ring of several cameras
  int width = 0, height = 0;  // 0: as they come
  bool depth = false;         // wanted beside the colours, where the source has it: ring, folder, RealSense
};

// Whether `spec` is a recording: every frame of it counts, at its own time, and it ends.
bool IsRecording(const std::string& spec);

// spec, KIND:WHERE:
//   ring:/NAME       shared memory of another process (frame_ring.h); exposure times are the writer's
//   v4l2:DEVICE      through OpenCV; exposure times are the driver's (CLOCK_MONOTONIC)
//   realsense:SERIAL or realsense: (any one); only where librealsense2 was found at configure time
//   folder:DIR       its pictures by name; a name that is a number of 10 digits or more is the exposure time
//                    in us, otherwise they are 40 ms apart. NAME_o.jpg or .png is a colour picture with its
//                    depth (16 bits, mm) in NAME_depth.png; there NAME may have fewer digits
//   video:FILE       of constant rate, through OpenCV
// Throws std::runtime_error in one line when there is none, or its pictures have another size.
//
// A live camera that goes away is looked for after .1 s, then less and less often, down to every 3 s. `say`
// hears when it went, why, and when it is back; called by whoever calls Next().
std::unique_ptr<FrameSource> OpenSource(const std::string& spec, const CameraRequest& camera,
                                        std::function<void(const std::string&)> say);

}  // namespace intabs
