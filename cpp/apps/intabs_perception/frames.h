// intabs_perception --frames: solves a folder of frames whose cameras are known, instead of a running
// plant's.
#pragma once

#include <string>
#include <vector>

namespace intabs {

struct FramesOptions {
  std::string dir;  // with frames.json: tag_size_m, cameras {name: K, width, height, X_WC}, frames [{images}]
  std::string result;    // where the poses go: [{"frame", "tags": {id: 4x4 X_WT}, "covariance": {id: 6x6}}]
  std::string json;      // figures; empty: none
  bool single = false;   // the first camera alone
  bool offline = false;  // poses are chosen by the frames after them too
  std::vector<double>
      extrinsic_sigma;       // mm, deg: how well the cameras' places beside the first one are known
  bool independent = false;  // frames have nothing to do with each other; frames.json may say so itself
};

// Every tag is an object of its own; one whose pose is not believed is left out. covariance: (rotation,
// translation) of X_WT Exp(xi), rad and m. Throws std::runtime_error with one line for a folder that does not
// hold.
void SolveFrames(const FramesOptions& options);

}  // namespace intabs
