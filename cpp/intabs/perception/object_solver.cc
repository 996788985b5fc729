#include "intabs/perception/object_solver.h"

#include <Eigen/LU>
#include <algorithm>
#include <cmath>

namespace intabs {
namespace {

constexpr double kOtherMinimum = 10 * M_PI / 180;  // two poses turned by more are two hypotheses
constexpr size_t kRefined = 4;                     // starts that are refined, best first

struct Candidate {
  Pose X_WO;
  double rms_px;
};

std::vector<PointView> PointsOf(std::span<const TagView> views) {
  std::vector<PointView> points;
  points.reserve(4 * views.size());
  for (const TagView& view : views) {
    const auto points_T = TagPoints(view.size);
    for (int k = 0; k < 4; ++k) points.push_back({view.X_OT * points_T[k], view.corners[k], view.camera});
  }
  return points;
}

ObjectFit SolveOnce(std::span<const PlacedCamera> cameras, std::span<const TagView> views,
                    const ObjectSolverLimits& limits) {
  ObjectFit out;
  const std::vector<PointView> points = PointsOf(views);
  std::vector<Candidate> starts;
  for (const TagView& view : views) {
    if (!view.hypotheses.ok) continue;
    for (const Pose& X_CT : view.hypotheses.X_CT) {
      const Pose X_WO = cameras[view.camera].X_WC * X_CT * view.X_OT.Inverse();
      starts.push_back({X_WO, ReprojectionRms(cameras, points, X_WO)});
    }
  }
  std::stable_sort(starts.begin(), starts.end(),
                   [](const Candidate& a, const Candidate& b) { return a.rms_px < b.rms_px; });
  std::vector<PoseFit> minima;
  for (size_t i = 0; i < starts.size() && i < kRefined; ++i) {
    PoseFit fit = FitPose(cameras, points, starts[i].X_WO);
    if (fit.ok) minima.push_back(fit);
  }
  if (minima.empty()) return out;
  std::stable_sort(minima.begin(), minima.end(),
                   [](const PoseFit& a, const PoseFit& b) { return a.rms_px < b.rms_px; });
  const PoseFit& best = minima.front();
  out.ok = true;
  out.X_WO = best.X_WO;
  out.rms_px = best.rms_px;
  for (const PoseFit& other : minima) {
    if (AngleBetween(best.X_WO.q, other.X_WO.q) > kOtherMinimum) {
      out.ambiguity = other.rms_px > 0 ? best.rms_px / other.rms_px : 1.0;
      break;
    }
  }
  // Residuals larger than the corners' usual noise tell of something that the noise does not know.
  const double freedom = std::max(1.0, 2.0 * points.size() - 6.0);
  const double chi2 = best.rms_px * best.rms_px * points.size() / freedom;
  const double variance = std::max(chi2, limits.corner_sigma_px * limits.corner_sigma_px);
  out.covariance = variance * best.information.inverse();
  out.tags = static_cast<int>(views.size());
  for (const TagView& view : views) out.cameras |= static_cast<uint8_t>(1u << view.camera);
  const bool alone = views.size() == 1;
  out.valid = out.rms_px <= limits.max_rms_px && !(alone && out.ambiguity > limits.max_ambiguity) &&
              out.covariance.allFinite();
  return out;
}

// The view with the largest residuals among those whose camera has another one; -1: none.
int WorstView(std::span<const PlacedCamera> cameras, std::span<const TagView> views, const Pose& X_WO) {
  int worst = -1;
  double worst_rms = 0;
  for (size_t i = 0; i < views.size(); ++i) {
    const auto same_camera = [&](const TagView& v) { return v.camera == views[i].camera; };
    if (std::count_if(views.begin(), views.end(), same_camera) < 2) continue;
    const double rms = ReprojectionRms(cameras, PointsOf(views.subspan(i, 1)), X_WO);
    if (rms > worst_rms) {
      worst = static_cast<int>(i);
      worst_rms = rms;
    }
  }
  return worst;
}

}  // namespace

ObjectFit SolveObject(std::span<const PlacedCamera> cameras, std::vector<TagView> views,
                      const ObjectSolverLimits& limits) {
  ObjectFit fit = SolveOnce(cameras, views, limits);
  while (fit.ok && fit.rms_px > limits.max_rms_px) {
    const int worst = WorstView(cameras, views, fit.X_WO);
    if (worst < 0) break;
    views.erase(views.begin() + worst);
    fit = SolveOnce(cameras, views, limits);
  }
  return fit;
}

std::array<float, 21> PackCovariance(const Matrix6d& covariance) {
  std::array<float, 21> out;
  int n = 0;
  for (int row = 0; row < 6; ++row) {
    for (int col = row; col < 6; ++col) out[n++] = static_cast<float>(covariance(row, col));
  }
  return out;
}

}  // namespace intabs
