// A window on a World. Mouse: left button turns, right moves, wheel zooms; Esc closes.
#pragma once

#include <memory>

#include "intabs/plant/world.h"

namespace intabs {

// One thread: the one that made it. It may be that of a Renderer.
class Viewer {
 public:
  // Throws std::runtime_error in one line when there is no display, or when this was built without GLFW.
  explicit Viewer(const World& world);
  ~Viewer();
  Viewer(const Viewer&) = delete;
  Viewer& operator=(const Viewer&) = delete;

  // Draws and looks after the mouse; call it 20 times a second or more. False once the window was closed.
  bool Show(const Snapshot& snapshot);

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace intabs
