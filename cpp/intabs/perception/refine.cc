#include "intabs/perception/refine.h"

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <vector>

namespace intabs {
namespace {

// The tag's plane in units of half its black edge: x right, y down, the black edge at +-1, the white border
// to 1.25.
constexpr double kCellsPerUnit = 4;
constexpr double kUsed = 1.125;  // half the white border; beyond it the background shines in
constexpr int kPixels = 2000;    // of the bounding box; larger tags are sampled
constexpr int kIterations = 10;
constexpr double kRobust = 0.15;                 // of the contrast: residuals from there on lose weight
constexpr double kMaxResidual = 0.12;            // of the contrast
constexpr double kMinContrast = 10;              // grey levels
constexpr double kMaxMove = 3.5;                 // px
constexpr double kMinBlur = 0.25, kMaxBlur = 2;  // px

// Homography from the tag's plane to pixels.
Eigen::Matrix3d FromCorners(const TagCorners& corners) {
  Eigen::Matrix<double, 8, 8> A;
  Eigen::Matrix<double, 8, 1> b;
  const auto points = TagPoints(2);
  for (int k = 0; k < 4; ++k) {
    const double x = points[k].x(), y = points[k].y(), u = corners[k].x(), v = corners[k].y();
    A.row(2 * k) << x, y, 1, 0, 0, 0, -u * x, -u * y;
    A.row(2 * k + 1) << 0, 0, 0, x, y, 1, -v * x, -v * y;
    b[2 * k] = u;
    b[2 * k + 1] = v;
  }
  const Eigen::Matrix<double, 8, 1> h = A.partialPivLu().solve(b);
  Eigen::Matrix3d H;
  H << h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], 1;
  return H;
}

// How much of each cell a look at place c (in cells), blurred by a Gaussian of sigma s, sees: weight, d
// weight/dc, d weight/ds.
struct Cells {
  int from = 0, to = 0;  // cells [from, to) are seen
  float weight[10], slope[10], widen[10];

  void Look(float c, float s) {
    const float reach = 3.5f * s;
    from = std::clamp(static_cast<int>(std::floor(c - reach)), 0, 9);
    to = std::clamp(static_cast<int>(std::floor(c + reach)), 0, 9) + 1;
    const float is = 1 / s;
    float below = 0, below_c = 0, below_s = 0;  // of the part that lies before cell i
    for (int i = from; i < to; ++i) {
      float part = 1, part_c = 0, part_s = 0;
      if (i + 1 < to) {  // the last one takes all the rest: the border is taken to go on
        const float z = (i + 1 - c) * is;
        const float density = 0.3989423f * std::exp(-0.5f * z * z) * is;
        part = 0.5f + 0.5f * std::erf(0.70710678f * z);
        part_c = -density;
        part_s = -density * z;
      }
      weight[i] = part - below;
      slope[i] = part_c - below_c;
      widen[i] = part_s - below_s;
      below = part;
      below_c = part_c;
      below_s = part_s;
    }
  }
};

struct Sample {
  float x, y;    // in the tag's plane
  float value;   // grey level of the image
  float model;   // 0 black .. 1 white
  float dx, dy;  // of the model by x and y
  float ds;      // of the model by the blur in px
};

}  // namespace

bool RefineCorners(const cv::Mat& gray, const TagPattern& pattern, TagCorners& corners) {
  Eigen::Matrix3d H = FromCorners(corners);
  if (!H.allFinite()) return false;
  const auto to_pixel = [&H](double x, double y) -> Eigen::Vector2d {
    return (H * Eigen::Vector3d(x, y, 1)).hnormalized();
  };
  double blur = 0.5;  // sigma [px]
  bool converged = false;
  double residual = 0;
  std::vector<Sample> samples;
  samples.reserve(2 * kPixels);

  for (int iteration = 0; iteration < kIterations && !converged; ++iteration) {
    Eigen::Vector2d lo(1e9, 1e9), hi(-1e9, -1e9);
    for (const Eigen::Vector3d& p : TagPoints(2 * kUsed)) {
      const Eigen::Vector2d uv = to_pixel(p.x(), p.y());
      lo = lo.cwiseMin(uv);
      hi = hi.cwiseMax(uv);
    }
    if (!(lo.minCoeff() > -1e4 && hi.maxCoeff() < 1e4)) return false;
    const int u0 = std::max(0, static_cast<int>(std::ceil(lo.x())));
    const int v0 = std::max(0, static_cast<int>(std::ceil(lo.y())));
    const int u1 = std::min(gray.cols - 1, static_cast<int>(std::floor(hi.x())));
    const int v1 = std::min(gray.rows - 1, static_cast<int>(std::floor(hi.y())));
    if (u1 < u0 || v1 < v0) return false;
    const double area = static_cast<double>(u1 - u0 + 1) * (v1 - v0 + 1);
    const int stride = std::max(1, static_cast<int>(std::ceil(std::sqrt(area / kPixels))));

    // What the model says of every pixel.
    const Eigen::Matrix3f Hi = H.inverse().cast<float>();
    samples.clear();
    Cells across, down;
    for (int v = v0; v <= v1; v += stride) {
      const uint8_t* row = gray.ptr<uint8_t>(v);
      for (int u = u0; u <= u1; u += stride) {
        const Eigen::Vector3f w = Hi * Eigen::Vector3f(u, v, 1);
        const float iz = 1 / w.z();
        Sample s;
        s.x = w.x() * iz;
        s.y = w.y() * iz;
        if (!(std::abs(s.x) <= kUsed && std::abs(s.y) <= kUsed)) continue;
        // Cells a pixel, along x and y: turns the blur in px into one in cells.
        const float per_px_x = 4 * iz * std::hypot(Hi(0, 0) - s.x * Hi(2, 0), Hi(0, 1) - s.x * Hi(2, 1));
        const float per_px_y = 4 * iz * std::hypot(Hi(1, 0) - s.y * Hi(2, 0), Hi(1, 1) - s.y * Hi(2, 1));
        across.Look(kCellsPerUnit * s.x + 5, static_cast<float>(blur) * per_px_x);
        down.Look(kCellsPerUnit * s.y + 5, static_cast<float>(blur) * per_px_y);
        s.value = row[u];
        s.model = s.dx = s.dy = s.ds = 0;
        for (int j = down.from; j < down.to; ++j) {
          float line = 0, line_dx = 0, line_ds = 0;
          for (int i = across.from; i < across.to; ++i) {
            const float p = pattern[10 * j + i];
            line += p * across.weight[i];
            line_dx += p * across.slope[i];
            line_ds += p * across.widen[i];
          }
          s.model += line * down.weight[j];
          s.dx += line_dx * down.weight[j];
          s.dy += line * down.slope[j];
          s.ds += line_ds * down.weight[j] * per_px_x + line * down.widen[j] * per_px_y;
        }
        s.dx *= kCellsPerUnit;
        s.dy *= kCellsPerUnit;
        samples.push_back(s);
      }
    }

    // Black and white level: a line through (model, value).
    double n = samples.size(), m = 0, mm = 0, g = 0, gm = 0;
    if (n < 40) return false;
    for (const Sample& s : samples) {
      m += s.model;
      mm += s.model * s.model;
      g += s.value;
      gm += s.value * s.model;
    }
    const double spread = n * mm - m * m;
    if (!(spread > 1e-6 * n * n)) return false;
    const float contrast = static_cast<float>((n * gm - m * g) / spread);
    const float black = static_cast<float>((g - contrast * m) / n);
    if (!(contrast >= kMinContrast)) return false;

    // Gauss-Newton over H <- H M(d), d = (shift, linear part, perspective), levels and blur.
    constexpr int kDim = 11;
    using Vector = Eigen::Matrix<float, 12, 1>;  // one of padding, for the sake of vector registers
    Eigen::Matrix<float, 12, 12> A = Eigen::Matrix<float, 12, 12>::Zero();
    Vector b = Vector::Zero();
    double squares = 0, weights = 0;
    const float scale = 1 / contrast;
    for (const Sample& s : samples) {
      const float r = (s.value - black) * scale - s.model;
      // A step d of the homography moves the place that a pixel looks at by -d.
      const float gx = -s.dx, gy = -s.dy, k = gx * s.x + gy * s.y;
      Vector J;
      J << gx, gy, gx * s.x, gx * s.y, gy * s.x, gy * s.y, k * s.x, k * s.y, 1, s.model, s.ds, 0;
      const float weight = 1 / (1 + r * r / static_cast<float>(kRobust * kRobust));
      A.noalias() += (weight * J) * J.transpose();
      b.noalias() += weight * r * J;
      squares += weight * r * r;
      weights += weight;
    }
    residual = std::sqrt(squares / weights);
    Eigen::Matrix<double, kDim, kDim> N = A.topLeftCorner<kDim, kDim>().cast<double>();
    N.diagonal() *= 1 + 1e-6;
    N(kDim - 1, kDim - 1) += 1e-3 * n;  // the blur hardly shows where cells are large: it stays where it is
    const Eigen::Matrix<double, kDim, 1> d = N.ldlt().solve(b.head<kDim>().cast<double>());
    if (!d.allFinite()) return false;
    Eigen::Matrix3d M;
    M << 1 + d[2], d[3], d[0], d[4], 1 + d[5], d[1], -d[6], -d[7], 1;
    H = H * M;
    H /= H(2, 2);
    blur = std::clamp(blur + std::clamp(d[10], -0.25, 0.25), kMinBlur, kMaxBlur);
    // In px: the corners move by about this.
    converged = d.head<8>().lpNorm<Eigen::Infinity>() * 0.5 * (hi - lo).maxCoeff() < 5e-3;
  }

  if (residual > kMaxResidual) return false;
  TagCorners refined;
  const auto points = TagPoints(2);
  for (int k = 0; k < 4; ++k) {
    refined[k] = to_pixel(points[k].x(), points[k].y());
    if (!((refined[k] - corners[k]).norm() <= kMaxMove)) return false;
  }
  corners = refined;
  return true;
}

}  // namespace intabs
