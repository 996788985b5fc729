#include "intabs/perception/gaps.h"

#include <algorithm>
#include <catch2/catch.hpp>
#include <cmath>
#include <cstdio>
#include <limits>
#include <map>
#include <random>
#include <vector>

#include "common/alloc_hook.h"

namespace intabs {
namespace {

constexpr double kPeriod = 1.0 / 30;
constexpr double kDeg = M_PI / 180;

struct Track {
  std::vector<double> time;
  std::vector<Pose> truth, seen;
  size_t size() const { return time.size(); }
};

// Reaches one after another with minimum jerk (Flash, Hogan, 1985): .25 to .5 m and 20 to 70 deg in .7 to 1.1
// s, 30 Hz, seen with 2 mm and 1 deg of noise a coordinate.
Track Reaches(unsigned seed, int reaches = 3) {
  std::mt19937 rng(seed);
  std::normal_distribution<double> normal;
  const auto uniform = [&](double a, double b) { return std::uniform_real_distribution<double>(a, b)(rng); };
  const auto direction = [&] { return Eigen::Vector3d(normal(rng), normal(rng), normal(rng)).normalized(); };
  Track track;
  Pose at{{0.2, 0, 0.1}, ExpSO3(2 * direction())};
  for (int i = 0; i < reaches; ++i) {
    const Eigen::Vector3d step = uniform(0.25, 0.5) * direction();
    const Eigen::Vector3d turn = uniform(20, 70) * kDeg * direction();
    const double duration = uniform(0.7, 1.1);
    const int n = static_cast<int>(duration / kPeriod);
    for (int k = 0; k < n; ++k) {
      const double x = static_cast<double>(k) / n;
      const double s = x * x * x * (10 - 15 * x + 6 * x * x);
      track.time.push_back(track.size() * kPeriod);
      track.truth.push_back({at.p + s * step, (at.q * ExpSO3(s * turn)).normalized()});
    }
    at = {at.p + step, (at.q * ExpSO3(turn)).normalized()};
  }
  for (const Pose& X : track.truth) {
    const Eigen::Vector3d dp(normal(rng), normal(rng), normal(rng));
    const Eigen::Vector3d da(normal(rng), normal(rng), normal(rng));
    track.seen.push_back({X.p + 0.002 * dp, (X.q * ExpSO3(kDeg * da)).normalized()});
  }
  return track;
}

struct Filled {
  std::vector<Pose> pose;
  std::vector<SampleState> state;
  std::vector<double> sigma;
};

const Pose kNowhere{Eigen::Vector3d::Constant(std::numeric_limits<double>::quiet_NaN()), {0, 0, 0, 0}};

Filled Fill(const Track& track, size_t first, size_t n, const GapOptions& options = {}) {
  Filled f{track.seen, std::vector(track.size(), SampleState::kMeasured), std::vector<double>(track.size())};
  for (size_t k = first; k < first + n; ++k) {
    f.pose[k] = kNowhere;
    f.state[k] = SampleState::kInvalid;
  }
  FillGaps(track.time, f.pose, f.state, options, f.sigma);
  return f;
}

struct Errors {
  double position = 0, angle = 0;  // RMS in the gap [mm], [deg]
};

Errors InGap(const Track& track, const Filled& f, size_t first, size_t n) {
  Errors e;
  for (size_t k = first; k < first + n; ++k) {
    e.position += (f.pose[k].p - track.truth[k].p).squaredNorm();
    e.angle += std::pow(AngleBetween(f.pose[k].q, track.truth[k].q), 2);
  }
  return {1e3 * std::sqrt(e.position / n), std::sqrt(e.angle / n) / kDeg};
}

double Median(std::vector<double> v) {
  std::sort(v.begin(), v.end());
  return v[v.size() / 2];
}

size_t SomewhereInside(unsigned seed, const Track& track, size_t n) {
  std::mt19937 rng(seed + 77777);
  return std::uniform_int_distribution<size_t>(6, track.size() - n - 7)(rng);
}

// Median RMS error over seeds, each with one gap of n missing samples at a place of its own.
Errors Score(int n, const GapOptions& options, unsigned first_seed = 1, unsigned seeds = 200) {
  std::vector<double> position, angle;
  for (unsigned seed = first_seed; seed < first_seed + seeds; ++seed) {
    const Track track = Reaches(seed);
    const size_t at = SomewhereInside(seed, track, n);
    const Errors e = InGap(track, Fill(track, at, n, options), at, n);
    position.push_back(e.position);
    angle.push_back(e.angle);
  }
  return {Median(position), Median(angle)};
}

}  // namespace

TEST_CASE("Gaps in reaches are filled to 5 mm at .2 s and 10 mm at .4 s") {
  for (const unsigned first : {1u, 201u, 401u}) {
    CAPTURE(first);
    const Errors e2 = Score(6, {}, first), e4 = Score(12, {}, first);
    CAPTURE(e2.position, e4.position, e2.angle, e4.angle);
    CHECK(e2.position <= 5);
    CHECK(e4.position <= 10);
    CHECK(e2.angle <= 2);
    CHECK(e4.angle <= 4);
    const GapOptions thesis{.method = GapMethod::kLinear};
    CHECK(e4.position < 0.5 * Score(12, thesis, first).position);
  }
}

// perception_gaps_test "[table]"
TEST_CASE("Table of errors by gap and method", "[.table]") {
  std::printf("gap s  linear mm  Kalman mm  SLERP deg  log map deg\n");
  for (const int n : {3, 6, 9, 12, 14, 20}) {
    const Errors thesis = Score(n, {.method = GapMethod::kLinear, .max_gap = 1}, 1, 400);
    const Errors ours = Score(n, {.max_gap = 1, .slerp_gap = 0}, 1, 400);
    std::printf("%.2f  %9.1f  %9.1f  %9.1f  %9.1f\n", n * kPeriod, thesis.position, ours.position,
                thesis.angle, ours.angle);
  }
  std::printf("causal, s after the last measurement:  predicted mm  held mm  predicted deg  held deg\n");
  for (const int n : {1, 3, 6, 12}) {
    std::vector<double> p, held, a, held_a;
    for (unsigned seed = 1; seed <= 400; ++seed) {
      const Track track = Reaches(seed);
      const size_t at = SomewhereInside(seed, track, n);
      GapTracker tracker;
      for (size_t k = 0; k < at; ++k) (void)tracker.Update(track.time[k], track.seen[k]);
      const Pose& X = track.truth[at + n - 1];
      const Pose guess = tracker.Predict(track.time[at + n - 1]).pose;
      p.push_back(1e3 * (guess.p - X.p).norm());
      held.push_back(1e3 * (track.seen[at - 1].p - X.p).norm());
      a.push_back(AngleBetween(guess.q, X.q) / kDeg);
      held_a.push_back(AngleBetween(track.seen[at - 1].q, X.q) / kDeg);
    }
    std::printf("%.2f  %9.1f  %9.1f  %9.1f  %9.1f\n", n * kPeriod, Median(p), Median(held), Median(a),
                Median(held_a));
  }
}

TEST_CASE("The standard deviation of a filled position is what the error shows") {
  for (const int n : {3, 6, 12}) {
    int inside = 0, all = 0;
    for (unsigned seed = 1; seed <= 300; ++seed) {
      const Track track = Reaches(seed);
      const size_t at = SomewhereInside(seed, track, n);
      const Filled f = Fill(track, at, n);
      const size_t middle = at + n / 2;
      for (int i = 0; i < 3; ++i, ++all) {
        inside += std::abs(f.pose[middle].p[i] - track.truth[middle].p[i]) < 1.96 * f.sigma[middle];
      }
    }
    CAPTURE(n, inside, all);
    CHECK(inside > 0.85 * all);
    CHECK(inside < 0.995 * all);
  }
}

TEST_CASE("Measured poses stay as they are, and only gaps between measurements are filled") {
  const Track track = Reaches(3);
  for (const GapMethod method : {GapMethod::kKalman, GapMethod::kLinear}) {
    Filled f{track.seen, std::vector(track.size(), SampleState::kMeasured),
             std::vector<double>(track.size())};
    for (const size_t k : {size_t{0}, size_t{1}, size_t{20}, size_t{21}, track.size() - 1}) {
      f.pose[k] = kNowhere;
      f.state[k] = SampleState::kInvalid;
    }
    FillGaps(track.time, f.pose, f.state, {.method = method}, f.sigma);
    for (size_t k = 0; k < track.size(); ++k) {
      CAPTURE(k);
      const bool outside = k < 2 || k == track.size() - 1;
      if (outside) {
        REQUIRE(f.state[k] == SampleState::kInvalid);
        REQUIRE(f.sigma[k] == 0);
      } else if (k == 20 || k == 21) {
        REQUIRE(f.state[k] == SampleState::kFilled);
        REQUIRE((f.pose[k].p - track.truth[k].p).norm() < 0.02);
        REQUIRE(f.sigma[k] > 0.0005);
      } else {
        REQUIRE(f.state[k] == SampleState::kMeasured);
        REQUIRE(f.pose[k].p == track.seen[k].p);
        REQUIRE(f.pose[k].q.coeffs() == track.seen[k].q.coeffs());
      }
    }
  }
}

TEST_CASE("A gap over half a second stays invalid, and says nothing of its other side") {
  const Track track = Reaches(5);
  REQUIRE(Fill(track, 20, 14).state[25] == SampleState::kFilled);  // .5 s between the measurements
  const Filled f = Fill(track, 20, 15);
  for (size_t k = 20; k < 35; ++k) REQUIRE(f.state[k] == SampleState::kInvalid);
  REQUIRE(f.state[35] == SampleState::kMeasured);

  // A gap after the long one comes out the same, whatever was before it.
  const auto second = [&](size_t from) {
    std::vector<Pose> pose(track.seen.begin() + from, track.seen.end());
    std::vector<SampleState> state(pose.size(), SampleState::kMeasured);
    for (size_t k = 20; k < 35; ++k)
      if (k >= from) state[k - from] = SampleState::kInvalid;
    for (size_t k = 45; k < 50; ++k) state[k - from] = SampleState::kInvalid;
    FillGaps({track.time.data() + from, pose.size()}, pose, state);
    return pose[47 - from].p;
  };
  REQUIRE(second(0) == second(35));
}

TEST_CASE("Points are filled as positions are") {
  const Track track = Reaches(6);
  std::vector<Eigen::Vector3d> points;
  for (const Pose& X : track.seen) points.push_back(X.p);
  std::vector<SampleState> state(track.size(), SampleState::kMeasured);
  for (size_t k = 30; k < 36; ++k) state[k] = SampleState::kInvalid;
  FillPointGaps(track.time, points, state);
  const Filled f = Fill(track, 30, 6);
  for (size_t k = 30; k < 36; ++k) {
    REQUIRE(points[k] == f.pose[k].p);
    REQUIRE(state[k] == SampleState::kFilled);
  }
}

TEST_CASE("The thesis' method is a straight line and SLERP") {
  Track track;
  const Eigen::Vector3d turn(0.3, -0.2, 0.6);
  for (int k = 0; k < 10; ++k) {
    const double t = k * kPeriod;
    track.time.push_back(t);
    track.truth.push_back({Eigen::Vector3d(t, 2 * t, -t), ExpSO3(t * turn)});
  }
  track.seen = track.truth;
  const Filled f = Fill(track, 3, 5, {.method = GapMethod::kLinear});
  REQUIRE(InGap(track, f, 3, 5).position < 1e-9);
  REQUIRE(InGap(track, f, 3, 5).angle < 1e-6);
}

TEST_CASE("Rotations follow the shorter way, whatever the quaternion's sign") {
  const Track track = Reaches(8);
  Track flipped = track;
  for (size_t k = 0; k < flipped.size(); k += 2) flipped.seen[k].q.coeffs() *= -1;
  for (const double slerp : {0.0, 1.0}) {
    const Filled a = Fill(track, 25, 12, {.slerp_gap = slerp}),
                 b = Fill(flipped, 25, 12, {.slerp_gap = slerp});
    for (size_t k = 25; k < 37; ++k) REQUIRE(AngleBetween(a.pose[k].q, b.pose[k].q) < 1e-6);
  }
}

TEST_CASE("What cannot be a track is refused by name") {
  std::vector<double> time{0, 0.1, 0.1};
  std::vector<Pose> pose(3);
  std::vector<SampleState> state(3, SampleState::kMeasured);
  REQUIRE_THROWS_WITH(FillGaps(time, pose, state), Catch::Contains("time does not rise at sample 2"));
  time[2] = 0.2;
  state.resize(2);
  REQUIRE_THROWS_WITH(FillGaps(time, pose, state), Catch::Contains("3 times"));
  state.resize(3, SampleState::kMeasured);
  pose[1] = kNowhere;
  REQUIRE_THROWS_WITH(FillGaps(time, pose, state), Catch::Contains("pose 1"));
  state[1] = SampleState::kInvalid;
  REQUIRE_NOTHROW(FillGaps(time, pose, state));
  std::vector<SampleState> none(3, SampleState::kInvalid);
  REQUIRE_NOTHROW(FillGaps(time, pose, none));
  REQUIRE_NOTHROW(FillGaps({}, {}, {}));
}

TEST_CASE("The tracker predicts better than holding, and its covariance grows with the error") {
  for (const int n : {3, 6, 12}) {
    std::vector<double> predicted, held;
    int inside = 0, all = 0;
    for (unsigned seed = 1; seed <= 300; ++seed) {
      const Track track = Reaches(seed);
      const size_t at = SomewhereInside(seed, track, n);
      GapTracker tracker;
      for (size_t k = 0; k < at; ++k) REQUIRE(tracker.Update(track.time[k], track.seen[k]));
      const Pose& X = track.truth[at + n - 1];
      const GapEstimate e = tracker.Predict(track.time[at + n - 1]);
      REQUIRE(e.valid);
      REQUIRE(e.age == Approx(n * kPeriod));
      predicted.push_back((e.pose.p - X.p).norm());
      held.push_back((track.seen[at - 1].p - X.p).norm());
      for (int i = 0; i < 3; ++i, ++all) inside += std::abs(e.pose.p[i] - X.p[i]) < 1.96 * e.sigma;
    }
    CAPTURE(n, Median(predicted), Median(held), inside, all);
    CHECK(Median(predicted) < 0.75 * Median(held));
    CHECK(inside > 0.85 * all);
    CHECK(inside < 0.999 * all);
  }
}

TEST_CASE(
    "Without measurements the tracker comes to rest, its doubt grows, and after max_gap it is invalid") {
  const Track track = Reaches(4);
  GapTracker tracker;
  REQUIRE_FALSE(tracker.Predict(0).valid);
  for (size_t k = 0; k < 40; ++k) REQUIRE(tracker.Update(track.time[k], track.seen[k]));
  const double t = track.time[39];
  double sigma = 0;
  for (int k = 0; k <= 15; ++k) {
    const GapEstimate e = tracker.Predict(t + k * kPeriod);
    CAPTURE(k);
    REQUIRE(e.valid);
    REQUIRE(e.sigma > sigma);
    sigma = e.sigma;
  }
  REQUIRE_FALSE(tracker.Predict(t + 0.51).valid);
  REQUIRE((tracker.Predict(t + 9).pose.p - tracker.Predict(t + 8).pose.p).norm() < 1e-6);
  // Predicting changes nothing; a measurement takes over at once.
  REQUIRE(tracker.Predict(t).age == 0);
  const Pose far{{1, 1, 1}, Eigen::Quaterniond::Identity()};
  REQUIRE(tracker.Update(t + 0.6, far));
  REQUIRE(tracker.Predict(t + 0.6).pose.p == far.p);
  tracker.Reset();
  REQUIRE_FALSE(tracker.Predict(t + 0.6).valid);
}

TEST_CASE("Velocities of the tracker die away with their time constant, between measurements too") {
  const double decay = GENERATE(0.1, 0.3, 1.0);
  GapTracker tracker({.max_gap = 5, .sigma = 1e-5, .sigma_angle = 1e-5, .decay = decay});
  const Eigen::Vector3d v(0.3, -0.1, 0.2), w(0.4, 0.2, -0.6);
  const Pose start{{0.1, 0.2, 0.3}, ExpSO3({0.3, 0.2, -0.1})};
  double t = 0;
  for (; t < 1; t += 0.01) {
    REQUIRE(tracker.Update(t, {start.p + t * v, (start.q * ExpSO3(t * w)).normalized()}));
  }
  t -= 0.01;
  const Pose last = tracker.Predict(t).pose;
  const auto gone = [&](double dt) { return (tracker.Predict(t + dt).pose.p - last.p).norm(); };
  const auto turned = [&](double dt) { return AngleBetween(tracker.Predict(t + dt).pose.q, last.q); };
  CHECK(gone(0.01) == Approx(0.01 * v.norm()).epsilon(0.1));
  CHECK(turned(0.01) == Approx(0.01 * w.norm()).epsilon(0.1));
  // The way gone in equal times shrinks by exp(-dt / decay).
  const double keep = std::exp(-0.2 / decay);
  CHECK((gone(0.4) - gone(0.2)) / gone(0.2) == Approx(keep).epsilon(1e-6));
  CHECK((turned(0.4) - turned(0.2)) / turned(0.2) == Approx(keep).epsilon(1e-4));
  // A measurement that tells nothing changes nothing of all that.
  const GapEstimate straight = tracker.Predict(t + 0.5);
  REQUIRE(tracker.Update(t + 0.2, {{9, 9, 9}, Eigen::Quaterniond(0, 1, 0, 0)}, 1e7, 1e7));
  REQUIRE(tracker.Update(t + 0.3, {{9, 9, 9}, Eigen::Quaterniond(0, 1, 0, 0)}, 1e7, 1e7));
  const GapEstimate stepped = tracker.Predict(t + 0.5);
  CHECK((stepped.pose.p - straight.pose.p).norm() < 1e-6);
  CHECK(AngleBetween(stepped.pose.q, straight.pose.q) < 1e-6);
  CHECK(stepped.sigma == Approx(straight.sigma).epsilon(1e-6));
  CHECK(stepped.sigma_angle == Approx(straight.sigma_angle).epsilon(1e-6));
}

TEST_CASE("The tracker follows a good measurement more closely than a bad one") {
  GapTracker good, bad;
  for (GapTracker* tracker : {&good, &bad}) REQUIRE(tracker->Update(0, Pose{}));
  const Pose moved{{0.02, 0, 0}, Eigen::Quaterniond::Identity()};
  REQUIRE(good.Update(0.1, moved, 1e-4, 1e-3));
  REQUIRE(bad.Update(0.1, moved, 0.1, 1));
  CHECK(good.Predict(0.1).pose.p.x() == Approx(0.02).epsilon(1e-3));
  CHECK(bad.Predict(0.1).pose.p.x() < 0.01);
  CHECK(good.Predict(0.1).sigma < bad.Predict(0.1).sigma);
  REQUIRE_FALSE(good.Update(0.2, moved, 0, 1));
}

TEST_CASE("The tracker refuses what is no measurement") {
  GapTracker tracker;
  REQUIRE(tracker.Update(1.0, Pose{}));
  REQUIRE_FALSE(tracker.Update(1.0, Pose{}));
  REQUIRE_FALSE(tracker.Update(0.5, Pose{}));
  REQUIRE_FALSE(tracker.Update(2.0, kNowhere));
  REQUIRE_FALSE(tracker.Update(std::nan(""), Pose{}));
  REQUIRE_FALSE(tracker.Update(2.0, Pose{Eigen::Vector3d::Zero(), {2, 0, 0, 0}}));
  REQUIRE(tracker.Predict(1.0).valid);
  REQUIRE(tracker.Predict(0.2).pose.p == Pose{}.p);
}

TEST_CASE("The tracker does not allocate") {
  if (!AllocationHookActive()) {
    WARN("skipped: sanitizers own the allocator");
    return;
  }
  REQUIRE(AllocationHookSeesAll());
  const Track track = Reaches(2);
  GapTracker tracker;
  bool all = true;
  const AllocationCounter counter;
  for (size_t k = 0; k < track.size(); ++k) {
    all &= tracker.Update(track.time[k], track.seen[k]);
    all &= tracker.Predict(track.time[k] + 0.1).valid;
  }
  const auto n = counter.count();
  REQUIRE(n == 0);
  REQUIRE(all);
}

}  // namespace intabs
