#pragma once

#include <memory>
#include <string>

#include "intabs/camera/frame_source.h"

namespace intabs {

// Colour frames, with depth where it is wanted, of the RealSense camera with that serial number; empty: any.
// Throws when there is none, or this build has no librealsense2.
std::unique_ptr<FrameSource> OpenRealSense(const std::string& serial, const CameraRequest& camera);

}  // namespace intabs
