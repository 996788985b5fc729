#include "intabs/perception/refine.h"

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <span>
#include <vector>

namespace intabs {
namespace {

// The tag's plane in units of half its black edge: x right, y down, the black edge at +-1, the white border
// to 1.25.
constexpr double kCellsPerUnit = 4;
constexpr double kUsed = 1.125;  // half the white border; beyond it the background shines in
constexpr int kPixels = 2000;    // of the bounding box; larger tags are sampled
constexpr int kIterations = 10;
constexpr double kRobust = 0.15;       // of the contrast: residuals from there on lose weight
constexpr double kMaxResidual = 0.12;  // of the contrast
constexpr double kMinNoise = 0.005;    // of the contrast: rounding to whole grey levels
constexpr double kSurroundings = 0.5;  // of the contrast: how unlike the white border its surroundings are
constexpr double kModelError = 0.005;  // px a corner: what the pattern, blur and noise do not explain
constexpr double kMinContrast = 10;    // grey levels
constexpr double kMaxMove = 3.5;       // px
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
  int u, v;      // of the pixel, in steps of the sampling
  float beyond;  // share of the look that falls outside the white border, where nobody knows what is
};

// Share of a look at c (in cells) with blur s that falls outside [0, 10].
float Beyond(float c, float s) {
  const float d = std::min(c, 10 - c);
  return d > 3 * s ? 0 : 0.5f * std::erfc(0.70710678f * d / s);
}

// Gauss-Hermite nodes and weights for a standard normal variable.
struct Node {
  float at, weight;
};
constexpr Node kOneNode[] = {{0, 1}};
constexpr Node kThreeNodes[] = {{-1.7320508f, 1 / 6.f}, {0, 2 / 3.f}, {1.7320508f, 1 / 6.f}};
constexpr Node kFiveNodes[] = {{-2.8569700f, 0.011257411f},
                               {-1.3556262f, 0.22207592f},
                               {0, 0.53333333f},
                               {1.3556262f, 0.22207592f},
                               {2.8569700f, 0.011257411f}};
// A blur that is round in the picture lies aslant in the plane of an oblique tag, and a product of two blurs
// along x and y cannot be aslant: its slanted part (by the correlation of x and y) is summed over nodes.
std::span<const Node> NodesFor(float correlation) {
  if (correlation < 0.05f) return kOneNode;
  if (correlation < 0.5f) return kThreeNodes;
  return kFiveNodes;
}

// Adds what one look at (x, y) of the tag's plane sees, blurred by sigma_x, sigma_y (in cells) along the
// axes. dsx, dsy: derivatives by the two sigmas.
void Look(const TagPattern& pattern, float x, float y, float sigma_x, float sigma_y, float weight,
          Cells& across, Cells& down, Sample& s, float& dsx, float& dsy) {
  across.Look(static_cast<float>(kCellsPerUnit) * x + 5, sigma_x);
  down.Look(static_cast<float>(kCellsPerUnit) * y + 5, sigma_y);
  float model = 0, dx = 0, dy = 0, sx = 0, sy = 0;
  for (int j = down.from; j < down.to; ++j) {
    float line = 0, line_dx = 0, line_ds = 0;
    for (int i = across.from; i < across.to; ++i) {
      const float p = pattern[10 * j + i];
      line += p * across.weight[i];
      line_dx += p * across.slope[i];
      line_ds += p * across.widen[i];
    }
    model += line * down.weight[j];
    dx += line_dx * down.weight[j];
    dy += line * down.slope[j];
    sx += line_ds * down.weight[j];
    sy += line * down.widen[j];
  }
  s.model += weight * model;
  s.dx += weight * dx;
  s.dy += weight * dy;
  dsx += weight * sx;
  dsy += weight * sy;
}

// How many times larger a variance is because neighbouring residuals are alike (the picture differs from the
// model, not by noise alone): for an autocorrelation that falls off geometrically along both axes.
double Inflation(const std::vector<Sample>& samples, const std::vector<float>& residuals) {
  double square = 0, across = 0, down = 0;
  int n_across = 0, n_down = 0;
  size_t above = 0;  // walks along the row above
  for (size_t i = 0; i < samples.size(); ++i) {
    const Sample& s = samples[i];
    square += residuals[i] * residuals[i];
    if (i > 0 && samples[i - 1].v == s.v && samples[i - 1].u == s.u - 1) {
      across += residuals[i] * residuals[i - 1];
      ++n_across;
    }
    while (above < i &&
           (samples[above].v < s.v - 1 || (samples[above].v == s.v - 1 && samples[above].u < s.u))) {
      ++above;
    }
    if (samples[above].v == s.v - 1 && samples[above].u == s.u) {
      down += residuals[i] * residuals[above];
      ++n_down;
    }
  }
  const double variance = square / static_cast<double>(samples.size());
  const auto factor = [&](double sum, int n) {
    const double rho = n > 0 ? std::clamp(sum / (n * variance), -0.2, 0.9) : 0.0;
    return (1 + rho) / (1 - rho);
  };
  return factor(across, n_across) * factor(down, n_down);
}

}  // namespace

bool RefineCorners(const cv::Mat& gray, const TagPattern& pattern, TagCorners& corners,
                   Matrix8d* covariance) {
  Eigen::Matrix3d H = FromCorners(corners);
  if (!H.allFinite()) return false;
  const auto to_pixel = [&H](double x, double y) -> Eigen::Vector2d {
    return (H * Eigen::Vector3d(x, y, 1)).hnormalized();
  };
  double blur = 0.5;  // sigma [px]
  bool converged = false;
  double residual = 0.05;
  constexpr int kDim = 11;  // of the fit: homography, levels, blur
  Eigen::Matrix<double, kDim, kDim> N;
  std::vector<Sample> samples;
  std::vector<float> residuals;
  samples.reserve(2 * kPixels);
  residuals.reserve(2 * kPixels);

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
    const float sigma = static_cast<float>(blur);
    for (int v = v0; v <= v1; v += stride) {
      const uint8_t* row = gray.ptr<uint8_t>(v);
      for (int u = u0; u <= u1; u += stride) {
        const Eigen::Vector3f w = Hi * Eigen::Vector3f(u, v, 1);
        const float iz = 1 / w.z();
        Sample s;
        s.x = w.x() * iz;
        s.y = w.y() * iz;
        if (!(std::abs(s.x) <= kUsed && std::abs(s.y) <= kUsed)) continue;
        // Cells a pixel: turns the blur in px into one in cells.
        const float xu = 4 * iz * (Hi(0, 0) - s.x * Hi(2, 0)), xv = 4 * iz * (Hi(0, 1) - s.x * Hi(2, 1));
        const float yu = 4 * iz * (Hi(1, 0) - s.y * Hi(2, 0)), yv = 4 * iz * (Hi(1, 1) - s.y * Hi(2, 1));
        const float per_px_x = std::hypot(xu, xv), per_px_y = std::hypot(yu, yv);
        const float covariance = xu * yu + xv * yv;
        const float slant = std::abs(covariance) / (per_px_x * per_px_y);
        const auto nodes = NodesFor(slant);
        // The part along the axes, and the one along (slant_x, slant_y), all a pixel of blur.
        const float axes = nodes.size() == 1 ? 1 : std::sqrt(std::max(1 - slant, 1e-3f));
        const float slant_x = std::sqrt(slant) * per_px_x;
        const float slant_y = std::copysign(std::sqrt(slant) * per_px_y, covariance);
        s.u = (u - u0) / stride;
        s.v = (v - v0) / stride;
        s.beyond = Beyond(static_cast<float>(kCellsPerUnit) * s.x + 5, sigma * per_px_x) +
                   Beyond(static_cast<float>(kCellsPerUnit) * s.y + 5, sigma * per_px_y);
        s.value = row[u];
        s.model = s.dx = s.dy = s.ds = 0;
        for (const Node& node : nodes) {
          const float away_x = 0.25f * node.at * slant_x,
                      away_y = 0.25f * node.at * slant_y;  // units of x, y
          float dsx = 0, dsy = 0;
          const float dx = s.dx, dy = s.dy;
          Look(pattern, s.x + sigma * away_x, s.y + sigma * away_y, sigma * axes * per_px_x,
               sigma * axes * per_px_y, node.weight, across, down, s, dsx, dsy);
          s.ds +=
              axes * (per_px_x * dsx + per_px_y * dsy) + 4 * ((s.dx - dx) * away_x + (s.dy - dy) * away_y);
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
    using Vector = Eigen::Matrix<float, 12, 1>;  // one of padding, for the sake of vector registers
    Eigen::Matrix<float, 12, 12> A = Eigen::Matrix<float, 12, 12>::Zero();
    Vector b = Vector::Zero();
    double squares = 0, weights = 0;
    residuals.clear();
    const float scale = 1 / contrast;
    const double noise = std::max(residual, kMinNoise);
    const float surroundings = static_cast<float>(kSurroundings * kSurroundings / (noise * noise));
    for (const Sample& s : samples) {
      const float r = (s.value - black) * scale - s.model;
      // A step d of the homography moves the place that a pixel looks at by -d.
      const float gx = -s.dx, gy = -s.dy, k = gx * s.x + gy * s.y;
      Vector J;
      J << gx, gy, gx * s.x, gx * s.y, gy * s.x, gy * s.y, k * s.x, k * s.y, 1, s.model, s.ds, 0;
      const float weight =
          1 / (1 + r * r / static_cast<float>(kRobust * kRobust)) / (1 + s.beyond * s.beyond * surroundings);
      A.noalias() += (weight * J) * J.transpose();
      b.noalias() += weight * r * J;
      residuals.push_back(std::sqrt(weight) * r);
      squares += weight * r * r;
      weights += weight;
    }
    residual = std::sqrt(squares / weights);
    N = A.topLeftCorner<kDim, kDim>().cast<double>();
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
  Eigen::Matrix<double, 8, kDim> G;  // of the corners by the step d
  G.setZero();
  for (int k = 0; k < 4; ++k) {
    const double x = points[k].x(), y = points[k].y();
    refined[k] = to_pixel(x, y);
    if (!((refined[k] - corners[k]).norm() <= kMaxMove)) return false;
    Eigen::Matrix<double, 2, 8> shift;
    shift << 1, 0, x, y, 0, 0, x * x, x * y, 0, 1, 0, 0, x, y, x * y, y * y;
    const double w = H.row(2).dot(Eigen::Vector3d(x, y, 1));
    const Eigen::Matrix2d to_px = (H.topLeftCorner<2, 2>() - refined[k] * H.block<1, 2>(2, 0)) / w;
    G.block<2, 8>(2 * k, 0) = to_px * shift;
  }
  if (covariance) {
    const double noise = std::max(residual, kMinNoise);
    *covariance = Inflation(samples, residuals) * noise * noise * G * N.ldlt().solve(G.transpose());
    covariance->diagonal().array() += kModelError * kModelError;
    if (!covariance->allFinite()) return false;
  }
  corners = refined;
  return true;
}

}  // namespace intabs
