#include "intabs/plant/viewer.h"

#include <stdexcept>

#ifdef INTABS_GLFW

#include <GLFW/glfw3.h>
#include <mujoco/mujoco.h>

#include <algorithm>
#include <string>

#include "intabs/plant/restore.h"

namespace intabs {

struct Viewer::Impl {
  std::shared_ptr<const mjModel> model;
  mjData* data = nullptr;
  GLFWwindow* window = nullptr;
  mjvCamera camera;
  mjvOption option;
  mjvScene scene;
  mjrContext gl;
  bool glfw = false, made = false;
  double x = 0, y = 0;  // of the mouse, last seen

  ~Impl() {
    if (made) {
      glfwMakeContextCurrent(window);
      mjr_freeContext(&gl);
      mjv_freeScene(&scene);
    }
    if (window != nullptr) glfwDestroyWindow(window);
    if (glfw) glfwTerminate();
    if (data != nullptr) mj_deleteData(data);
  }

  static Impl& Of(GLFWwindow* w) { return *static_cast<Impl*>(glfwGetWindowUserPointer(w)); }

  static void OnMove(GLFWwindow* w, double x, double y) {
    Impl& v = Of(w);
    int width, height;
    glfwGetWindowSize(w, &width, &height);
    const double dx = (x - v.x) / height, dy = (y - v.y) / height;
    v.x = x;
    v.y = y;
    if (glfwGetMouseButton(w, GLFW_MOUSE_BUTTON_LEFT) == GLFW_PRESS) {
      mjv_moveCamera(v.model.get(), mjMOUSE_ROTATE_V, dx, dy, &v.scene, &v.camera);
    } else if (glfwGetMouseButton(w, GLFW_MOUSE_BUTTON_RIGHT) == GLFW_PRESS) {
      mjv_moveCamera(v.model.get(), mjMOUSE_MOVE_V, dx, dy, &v.scene, &v.camera);
    }
  }
  static void OnScroll(GLFWwindow* w, double, double clicks) {
    mjv_moveCamera(Of(w).model.get(), mjMOUSE_ZOOM, 0, 0.05 * clicks, &Of(w).scene, &Of(w).camera);
  }
  static void OnKey(GLFWwindow* w, int key, int, int action, int) {
    if (key == GLFW_KEY_ESCAPE && action == GLFW_PRESS) glfwSetWindowShouldClose(w, GLFW_TRUE);
  }
};

Viewer::Viewer(const World& world) : impl_(std::make_unique<Impl>()) {
  Impl& v = *impl_;
  v.model = world.model();
  const mjModel* m = v.model.get();
  v.glfw = glfwInit();
  if (v.glfw) {
    // EGL, because a thread that has drawn through EGL (Renderer) cannot go on with GLX.
    glfwWindowHint(GLFW_CONTEXT_CREATION_API, GLFW_EGL_CONTEXT_API);
    v.window = glfwCreateWindow(1200, 900, "intabs_plant", nullptr, nullptr);
  }
  if (v.window == nullptr) {
    const char* reason = nullptr;
    glfwGetError(&reason);
    throw std::runtime_error("the viewer gets no window (" +
                             std::string(reason != nullptr ? reason : "no reason given") +
                             "): start it where there is a display, or without --viewer");
  }
  glfwMakeContextCurrent(v.window);
  glfwSwapInterval(0);  // nobody waits for the screen
  v.data = mj_makeData(m);
  mjv_defaultCamera(&v.camera);
  mjv_defaultOption(&v.option);
  mjv_defaultScene(&v.scene);
  mjr_defaultContext(&v.gl);
  mjv_makeScene(m, &v.scene, 1000);
  mjr_makeContext(m, &v.gl, mjFONTSCALE_100);
  v.made = true;
  v.scene.flags[mjRND_SHADOW] = 0;
  v.scene.flags[mjRND_REFLECTION] = 0;
  // From the robot's front right, the whole arm in sight.
  const double look_at[3] = {0.15, 0, 0.2};
  std::copy(look_at, look_at + 3, v.camera.lookat);
  v.camera.distance = 1.5;
  v.camera.azimuth = 135;
  v.camera.elevation = -25;
  glfwSetWindowUserPointer(v.window, &v);
  glfwSetCursorPosCallback(v.window, Impl::OnMove);
  glfwSetScrollCallback(v.window, Impl::OnScroll);
  glfwSetKeyCallback(v.window, Impl::OnKey);
}

Viewer::~Viewer() = default;

bool Viewer::Show(const Snapshot& snapshot) {
  Impl& v = *impl_;
  glfwPollEvents();
  if (glfwWindowShouldClose(v.window)) return false;
  glfwMakeContextCurrent(v.window);
  Restore(snapshot, v.model.get(), v.data);
  mjv_updateScene(v.model.get(), v.data, &v.option, nullptr, &v.camera, mjCAT_ALL, &v.scene);
  mjrRect viewport = {0, 0, 0, 0};
  glfwGetFramebufferSize(v.window, &viewport.width, &viewport.height);
  mjr_render(viewport, &v.scene, &v.gl);
  glfwSwapBuffers(v.window);
  return true;
}

}  // namespace intabs

#else

namespace intabs {

struct Viewer::Impl {};
Viewer::Viewer(const World&) {
  throw std::runtime_error(
      "built without a viewer: install libglfw3-dev and build again, or run without --viewer");
}
Viewer::~Viewer() = default;
bool Viewer::Show(const Snapshot&) { return false; }

}  // namespace intabs

#endif
