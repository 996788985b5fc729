// Pictures of a World without a window: EGL on Mesa's surfaceless platform, a GPU's own EGL otherwise.
// No shadows and no multisampling: about 10 ms a frame in software. One thread: the one that made it.
#pragma once

#include <cstdint>
#include <memory>
#include <string>

#include "intabs/plant/world.h"

namespace intabs {

class Renderer {
 public:
  // Throws in one line when EGL or the picture size is not to be had.
  Renderer(const World& world, int width, int height);
  ~Renderer();
  Renderer(const Renderer&) = delete;
  Renderer& operator=(const Renderer&) = delete;

  int width() const;
  int height() const;
  int num_cameras() const;                        // in the order of the scene: left, right, overview
  int FindCamera(const std::string& name) const;  // throws and lists the known ones
  void Render(const Snapshot& snapshot, int camera, uint8_t* rgb);  // H * W * 3, row 0 on top

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace intabs
