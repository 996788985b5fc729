#include "intabs/perception/object_solver.h"

#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <iterator>

namespace intabs {
namespace {

constexpr double kOtherMinimum = 10 * M_PI / 180;  // two poses turned by more are two hypotheses
constexpr size_t kRefined = 4;                     // starts that are refined, best first

// Chi-square of a single tag says little about its corners' noise; that of many tags says a lot. So it is
// weighed against so many degrees of freedom of what the corners' own covariances say.
constexpr double kPriorFreedom = 8;

struct Candidate {
  Pose X_WO;
  double rms_px;
};

struct Corners {
  std::vector<PointView> points;
  std::vector<Matrix8d> weights;  // one a view
};

Corners CornersOf(std::span<const TagView> views, double sigma_px) {
  Corners out;
  out.points.reserve(4 * views.size());
  out.weights.reserve(views.size());
  for (const TagView& view : views) {
    const auto points_T = TagPoints(view.size);
    for (int k = 0; k < 4; ++k) out.points.push_back({view.X_OT * points_T[k], view.corners[k], view.camera});
    out.weights.push_back(Whitening(view.covariance + sigma_px * sigma_px * Matrix8d::Identity()));
  }
  return out;
}

ObjectFit SolveOnce(std::span<const PlacedCamera> cameras, std::span<const TagView> views,
                    const ObjectSolverLimits& limits) {
  ObjectFit out;
  const auto [points, weights] = CornersOf(views, limits.corner_sigma_px);
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
    PoseFit fit = FitPose(cameras, points, starts[i].X_WO, weights);
    if (fit.ok) minima.push_back(fit);
  }
  if (minima.empty()) return out;
  std::stable_sort(minima.begin(), minima.end(),
                   [](const PoseFit& a, const PoseFit& b) { return a.cost < b.cost; });
  const PoseFit& best = minima.front();
  // Residuals larger than the corners' noise tell of something that the noise does not know.
  const double freedom = std::max(0.0, 2.0 * static_cast<double>(points.size()) - 6.0);
  const double variance = std::max(1.0, (best.cost + kPriorFreedom) / (freedom + kPriorFreedom));
  uint8_t used = 0;
  for (const TagView& view : views) used |= static_cast<uint8_t>(1u << view.camera);
  const auto add = [&](const PoseFit& fit) {
    out.minima.push_back({fit.X_WO, variance * fit.information.inverse(), fit.cost / (2 * variance), used});
  };
  add(best);
  out.ok = out.minima[0].covariance.allFinite();
  out.rms_px = best.rms_px;
  for (const PoseFit& other : minima) {
    if (AngleBetween(best.X_WO.q, other.X_WO.q) <= kOtherMinimum) continue;
    add(other);
    out.ambiguity = other.rms_px > 0 ? best.rms_px / other.rms_px : 1.0;
    out.p_wrong = Probability(out.minima[1].cost, out.minima[0].cost);
    break;
  }
  out.tags = static_cast<int>(views.size());
  out.valid = out.ok && out.rms_px <= limits.max_rms_px && out.p_wrong <= limits.max_wrong;
  return out;
}

// The view with the largest residuals among those whose camera has another one; -1: none.
int WorstView(std::span<const PlacedCamera> cameras, std::span<const TagView> views, const Pose& X_WO) {
  int worst = -1;
  double worst_rms = 0;
  for (size_t i = 0; i < views.size(); ++i) {
    const auto same_camera = [&](const TagView& v) { return v.camera == views[i].camera; };
    if (std::count_if(views.begin(), views.end(), same_camera) < 2) continue;
    const double rms = ReprojectionRms(cameras, CornersOf(views.subspan(i, 1), 0).points, X_WO);
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
    const int worst = WorstView(cameras, views, fit.minima[0].X_WO);
    if (worst < 0) break;
    views.erase(views.begin() + worst);
    fit = SolveOnce(cameras, views, limits);
  }
  if (!fit.ok || fit.rms_px <= limits.max_rms_px) return fit;
  fit.minima.clear();
  for (size_t c = 0; c < cameras.size(); ++c) {
    std::vector<TagView> own;
    std::copy_if(views.begin(), views.end(), std::back_inserter(own),
                 [&](const TagView& v) { return v.camera == static_cast<int>(c); });
    if (own.empty()) continue;
    const ObjectFit alone = SolveOnce(cameras, own, limits);
    if (!alone.ok || alone.rms_px > limits.max_rms_px) continue;
    for (ObjectPose minimum : alone.minima) {
      minimum.cost -= alone.minima[0].cost;  // those of different pictures cannot be compared
      fit.minima.push_back(minimum);
    }
  }
  fit.ok = !fit.minima.empty();
  return fit;
}

Matrix6d CovarianceOfChoice(const ObjectPose& chosen, const ObjectPose& other, double p_other) {
  Vector6d d;
  d << LogSO3(other.X_WO.q * chosen.X_WO.q.conjugate()), other.X_WO.p - chosen.X_WO.p;
  return (1 - p_other) * chosen.covariance + p_other * (other.covariance + d * d.transpose());
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
