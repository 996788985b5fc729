#include "intabs/plant/renderer.h"

#include <EGL/egl.h>
#include <EGL/eglext.h>
#include <mujoco/mujoco.h>

#include <algorithm>
#include <stdexcept>

#include "intabs/plant/restore.h"

namespace intabs {
namespace {

EGLDisplay OpenDisplay() {
  const auto get =
      reinterpret_cast<PFNEGLGETPLATFORMDISPLAYEXTPROC>(eglGetProcAddress("eglGetPlatformDisplayEXT"));
  if (get != nullptr) {
    const EGLDisplay display = get(EGL_PLATFORM_SURFACELESS_MESA, EGL_DEFAULT_DISPLAY, nullptr);
    if (display != EGL_NO_DISPLAY && eglInitialize(display, nullptr, nullptr)) return display;
  }
  const EGLDisplay display = eglGetDisplay(EGL_DEFAULT_DISPLAY);
  if (display != EGL_NO_DISPLAY && eglInitialize(display, nullptr, nullptr)) return display;
  throw std::runtime_error(
      "no EGL display: install libegl1, libegl-mesa0 and libgl1-mesa-dri, or run without cameras");
}

}  // namespace

struct Renderer::Impl {
  std::shared_ptr<const mjModel> model;
  mjData* data = nullptr;
  int width = 0, height = 0;
  EGLDisplay display = EGL_NO_DISPLAY;
  EGLContext context = EGL_NO_CONTEXT;
  mjvScene scene;
  mjvOption option;
  mjrContext gl;
  bool made = false;

  ~Impl() {
    if (made) {
      eglMakeCurrent(display, EGL_NO_SURFACE, EGL_NO_SURFACE, context);
      mjr_freeContext(&gl);
      mjv_freeScene(&scene);
    }
    if (context != EGL_NO_CONTEXT) {
      eglMakeCurrent(display, EGL_NO_SURFACE, EGL_NO_SURFACE, EGL_NO_CONTEXT);
      eglDestroyContext(display, context);
    }
    // The display is shared within the process and stays.
    if (data != nullptr) mj_deleteData(data);
  }
};

Renderer::Renderer(const World& world, int width, int height) : impl_(std::make_unique<Impl>()) {
  Impl& r = *impl_;
  r.model = world.model();
  r.width = width;
  r.height = height;
  const mjModel* m = r.model.get();
  if (width < 1 || height < 1 || width > m->vis.global.offwidth || height > m->vis.global.offheight) {
    throw std::runtime_error("pictures of " + std::to_string(width) + "x" + std::to_string(height) +
                             " do not fit the scene's offscreen buffer of " +
                             std::to_string(m->vis.global.offwidth) + "x" +
                             std::to_string(m->vis.global.offheight));
  }
  r.data = mj_makeData(m);
  r.display = OpenDisplay();
  const EGLint attributes[] = {EGL_RED_SIZE,
                               8,
                               EGL_GREEN_SIZE,
                               8,
                               EGL_BLUE_SIZE,
                               8,
                               EGL_ALPHA_SIZE,
                               8,
                               EGL_DEPTH_SIZE,
                               24,
                               EGL_STENCIL_SIZE,
                               8,
                               EGL_SURFACE_TYPE,
                               EGL_PBUFFER_BIT,
                               EGL_RENDERABLE_TYPE,
                               EGL_OPENGL_BIT,
                               EGL_NONE};
  EGLConfig config;
  EGLint n = 0;
  if (!eglChooseConfig(r.display, attributes, &config, 1, &n) || n < 1 || !eglBindAPI(EGL_OPENGL_API))
    throw std::runtime_error("EGL has no OpenGL configuration: install libgl1-mesa-dri");
  r.context = eglCreateContext(r.display, config, EGL_NO_CONTEXT, nullptr);
  if (r.context == EGL_NO_CONTEXT || !eglMakeCurrent(r.display, EGL_NO_SURFACE, EGL_NO_SURFACE, r.context))
    throw std::runtime_error("EGL gives no surfaceless OpenGL context: install libgl1-mesa-dri");
  mjv_defaultScene(&r.scene);
  mjv_defaultOption(&r.option);
  mjr_defaultContext(&r.gl);
  mjv_makeScene(m, &r.scene, 1000);
  mjr_makeContext(m, &r.gl, mjFONTSCALE_100);
  r.made = true;
  mjr_setBuffer(mjFB_OFFSCREEN, &r.gl);
  if (r.gl.currentBuffer != mjFB_OFFSCREEN) throw std::runtime_error("OpenGL gives no offscreen framebuffer");
  r.scene.flags[mjRND_SHADOW] = 0;
  r.scene.flags[mjRND_REFLECTION] = 0;
}

Renderer::~Renderer() = default;

int Renderer::width() const { return impl_->width; }
int Renderer::height() const { return impl_->height; }
int Renderer::num_cameras() const { return impl_->model->ncam; }

int Renderer::FindCamera(const std::string& name) const {
  const mjModel* m = impl_->model.get();
  const int id = mj_name2id(m, mjOBJ_CAMERA, name.c_str());
  if (id >= 0) return id;
  std::string known;
  for (int i = 0; i < m->ncam; ++i) known += std::string(i ? ", " : "") + mj_id2name(m, mjOBJ_CAMERA, i);
  throw std::runtime_error("the scene has no camera \"" + name + "\"; known: " + known);
}

void Renderer::Render(const Snapshot& s, int camera, uint8_t* rgb) {
  Impl& r = *impl_;
  const mjModel* m = r.model.get();
  if (camera < 0 || camera >= m->ncam || static_cast<int>(s.qpos.size()) != m->nq) {
    throw std::runtime_error("no picture: camera " + std::to_string(camera) + " of " + std::to_string(m->ncam) +
                             ", or a snapshot of another scene");
  }
  Restore(s, m, r.data);
  // Several renderers may live in one process.
  if (eglGetCurrentContext() != r.context)
    eglMakeCurrent(r.display, EGL_NO_SURFACE, EGL_NO_SURFACE, r.context);
  mjvCamera view;
  mjv_defaultCamera(&view);
  view.type = mjCAMERA_FIXED;
  view.fixedcamid = camera;
  mjv_updateScene(m, r.data, &r.option, nullptr, &view, mjCAT_ALL, &r.scene);
  const mjrRect viewport = {0, 0, r.width, r.height};
  mjr_render(viewport, &r.scene, &r.gl);
  mjr_readPixels(rgb, nullptr, viewport, &r.gl);
  const int row = 3 * r.width;  // OpenGL's row 0 is at the bottom
  for (int y = 0; y < r.height / 2; ++y)
    std::swap_ranges(rgb + y * row, rgb + (y + 1) * row, rgb + (r.height - 1 - y) * row);
}

}  // namespace intabs
