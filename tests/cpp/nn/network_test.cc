#include "intabs/nn/network.h"

#include <catch2/catch.hpp>
#include <limits>
#include <memory>
#include <optional>

#include "common/alloc_hook.h"
#include "intabs/nn/heads.h"
#include "intabs/nn/lstm.h"
#include "nn/random_weights.h"

using namespace intabs;

namespace {

const NetworkSpec kPi{.input = 9,
                      .input_linear = 16,
                      .layers = 3,
                      .hidden = 16,
                      .residual = true,
                      .heads = {{"a_log_std", 4}, {"a_mean", 4}, {"b", 1}, {"e_mean", 2}}};

Eigen::MatrixXf Inputs(int n, int T, unsigned seed) {
  std::mt19937 rng(seed);
  std::normal_distribution<float> normal;
  return Eigen::MatrixXf::NullaryExpr(n, T, [&] { return normal(rng); });
}

Eigen::VectorXf AllHeads(const Network& net) {
  std::vector<float> out;
  for (int i = 0; i < net.num_heads(); ++i) out.insert(out.end(), net.Head(i).begin(), net.Head(i).end());
  return Eigen::Map<Eigen::VectorXf>(out.data(), static_cast<int>(out.size()));
}

// The LSTM written out once more, straight from torch's documentation, in double and without any of our code.
std::vector<Eigen::VectorXd> ByTheBook(const WeightsFile& w, const NetworkSpec& s, const Eigen::MatrixXf& X) {
  const auto M = [&](const std::string& name) -> Eigen::MatrixXd {
    return w.tensor("net." + name).cast<double>();
  };
  const auto sigmoid = [](double v) { return 1 / (1 + std::exp(-v)); };
  std::vector<Eigen::VectorXd> h(s.layers, Eigen::VectorXd::Zero(s.hidden)), c = h, out;
  for (int t = 0; t < X.cols(); ++t) {
    Eigen::VectorXd x = X.col(t).cast<double>();
    if (s.input_linear > 0) x = (M("input.weight") * x + M("input.bias")).eval();
    for (int l = 0; l < s.layers; ++l) {
      const std::string p = "lstm." + std::to_string(l) + ".";
      const Eigen::VectorXd g =
          M(p + "weight_ih") * x + M(p + "bias_ih") + M(p + "weight_hh") * h[l] + M(p + "bias_hh");
      for (int k = 0; k < s.hidden; ++k) {
        const double i = sigmoid(g[k]), f = sigmoid(g[s.hidden + k]), gg = std::tanh(g[2 * s.hidden + k]),
                     o = sigmoid(g[3 * s.hidden + k]);
        c[l][k] = f * c[l][k] + i * gg;
        h[l][k] = o * std::tanh(c[l][k]);
      }
      x = s.residual && l > 0 ? Eigen::VectorXd(x + h[l]) : h[l];
    }
    out.push_back(x);
  }
  return out;
}

}  // namespace

TEMPLATE_TEST_CASE("The Eigen stack follows the equations", "", float, double) {
  const double bound = std::is_same_v<TestType, float> ? 1e-5 : 1e-12;
  for (const bool residual : {false, true}) {
    NetworkSpec s = kPi;
    s.residual = residual;
    s.input_linear = 0;
    const WeightsFile w = MakeRandomWeights(s, 3, 2);
    const Eigen::MatrixXf X = Inputs(s.input, 200, 4);
    const auto want = ByTheBook(w, s, X);
    Lstm<TestType> lstm(w, "net");
    Eigen::Matrix<TestType, Eigen::Dynamic, 1> y(s.hidden);
    double worst = 0;
    for (int t = 0; t < X.cols(); ++t) {
      const Eigen::Matrix<TestType, Eigen::Dynamic, 1> x = X.col(t).cast<TestType>();
      lstm.Step(x.data(), y.data());
      worst = std::max(worst, (y.template cast<double>() - want[t]).cwiseAbs().maxCoeff());
    }
    CAPTURE(residual);
    CHECK(worst <= bound);
  }
}

TEST_CASE("Step and Sequence agree, and Sequence leaves the state alone") {
  Network net(MakeRandomWeights(kPi, 5), "net");
  const Eigen::MatrixXf X = Inputs(kPi.input, 40, 6);
  const RowMatrixXf rows = X.transpose();
  std::vector<RowMatrixXf> heads;
  Network other = net;
  for (int t = 0; t < 40; ++t) {
    REQUIRE(net.Step(X.col(t).data()) == Status::kOk);
    REQUIRE(other.Step(X.col(t).data()) == Status::kOk);
    other.Sequence(rows.topRows(t + 1), heads);
    for (int i = 0; i < net.num_heads(); ++i) {
      REQUIRE((heads[i].row(t).transpose() - net.Head(i)).cwiseAbs().maxCoeff() < 1e-5f);
    }
  }
  CHECK(AllHeads(net) == AllHeads(other));
  net.EncodeFinal(rows);
  for (int i = 0; i < net.num_heads(); ++i) {
    CHECK((heads[i].row(39).transpose() - net.Head(i)).cwiseAbs().maxCoeff() < 1e-5f);
  }
}

TEST_CASE("Reset, saved and restored states, and copies give the same outputs again") {
  Network net(MakeRandomWeights(kPi, 7), "net");
  const Eigen::MatrixXf X = Inputs(kPi.input, 60, 8);
  std::vector<Eigen::VectorXf> first;
  std::vector<float> state(net.state_size());
  std::optional<Network> copy;
  for (int t = 0; t < 60; ++t) {
    if (t == 30) {
      net.SaveState(state.data());
      copy.emplace(net);
    }
    REQUIRE(net.Step(X.col(t).data()) == Status::kOk);
    first.push_back(AllHeads(net));
  }
  net.Reset();
  for (int t = 0; t < 60; ++t) {
    REQUIRE(net.Step(X.col(t).data()) == Status::kOk);
    REQUIRE(AllHeads(net) == first[t]);
  }
  net.RestoreState(state.data());
  for (int t = 30; t < 60; ++t) {
    REQUIRE(net.Step(X.col(t).data()) == Status::kOk);
    REQUIRE(copy->Step(X.col(t).data()) == Status::kOk);
    REQUIRE(AllHeads(net) == first[t]);
    REQUIRE(AllHeads(*copy) == first[t]);
  }
}

TEST_CASE("A copy outlives its original, by construction and by assignment") {
  const Eigen::MatrixXf X = Inputs(kPi.input, 5, 21);
  auto original = std::make_unique<Network>(MakeRandomWeights(kPi, 22), "net");
  Network other(MakeRandomWeights(kPi, 23), "net");
  std::vector<Eigen::VectorXf> want;
  for (int t = 0; t < 5; ++t) {
    REQUIRE(original->Step(X.col(t).data()) == Status::kOk);
    want.push_back(AllHeads(*original));
  }
  original->Reset();
  Network constructed = *original;
  other = *original;
  original.reset();
  for (int t = 0; t < 5; ++t) {
    REQUIRE(constructed.Step(X.col(t).data()) == Status::kOk);
    REQUIRE(other.Step(X.col(t).data()) == Status::kOk);
    CHECK(AllHeads(constructed) == want[t]);
    CHECK(AllHeads(other) == want[t]);
  }
}

TEST_CASE("An input that is not finite is refused and changes nothing") {
  Network net(MakeRandomWeights(kPi, 9), "net");
  Eigen::VectorXf x = Inputs(kPi.input, 1, 10);
  REQUIRE(net.Step(x.data()) == Status::kOk);
  std::vector<float> before(net.state_size()), after(net.state_size());
  net.SaveState(before.data());
  const Eigen::VectorXf heads = AllHeads(net);
  for (const float bad : {std::numeric_limits<float>::quiet_NaN(), -std::numeric_limits<float>::infinity()}) {
    Eigen::VectorXf broken = x;
    broken[kPi.input - 1] = bad;
    CHECK(net.Step(broken.data()) == Status::kInvalidInput);
  }
  net.SaveState(after.data());
  CHECK(before == after);
  CHECK(AllHeads(net) == heads);
}

TEST_CASE("With pool \"mean\" EncodeFinal is the mean over the ticks of what Sequence gives") {
  for (const bool skip : {false, true}) {
    NetworkSpec s = kPi;
    s.bidirectional = true;
    s.pool_mean = true;
    s.skip = skip;
    Network net(MakeRandomWeights(s, 11), "net");
    const RowMatrixXf X = Inputs(s.input, 23, 4).transpose();
    std::vector<RowMatrixXf> heads;
    net.Sequence(X, heads);
    net.EncodeFinal(X);
    for (int i = 0; i < net.num_heads(); ++i) {
      CHECK((net.Head(i).transpose() - heads[i].colwise().mean()).cwiseAbs().maxCoeff() < 1e-6f);
      CHECK((net.Head(i).transpose() - heads[i].row(22)).cwiseAbs().maxCoeff() > 1e-4f);
    }
  }
}

TEST_CASE("A bidirectional network has no tick, and a sequence of a wrong width is refused") {
  NetworkSpec s = kPi;
  s.bidirectional = true;
  Network net(MakeRandomWeights(s, 11), "net");
  CHECK(net.Step(Inputs(s.input, 1, 1).data()) == Status::kNotReady);
  const RowMatrixXf wrong = RowMatrixXf::Zero(4, s.input + 1);
  CHECK_THROWS_WITH(net.EncodeFinal(wrong), "network \"net\": the sequence is 4x10, wanted Tx9, T >= 1");
}

TEST_CASE("Heads know what they mean and refuse what does not fit") {
  Network net(MakeRandomWeights(kPi, 12), "net");
  const GaussianHead a(net, "a"), e(net, "e", -2.5f);
  const BernoulliHead b(net, "b");
  REQUIRE(net.Step(Inputs(kPi.input, 1, 13).col(0).data()) == Status::kOk);
  CHECK(a.Mean(net) == net.Head(net.HeadIndex("a_mean")));
  CHECK(a.LogStd(net) == net.Head(net.HeadIndex("a_log_std")));
  CHECK(e.LogStd(net) == Eigen::VectorXf::Constant(2, -2.5f));
  CHECK(b.Probability(net) == Approx(1 / (1 + std::exp(-b.Logit(net)))));
  CHECK_THROWS_WITH(GaussianHead(net, "z"),
                    "network \"net\" has no head \"z_mean\"; it has a_log_std, a_mean, b, e_mean");
  CHECK_THROWS_WITH(BernoulliHead(net, "a_mean"), "head \"a_mean\" has size 4, a Bernoulli head has 1");
}

TEST_CASE("Neither Step nor Reset nor the state allocates, in any weight format") {
  if (!AllocationHookActive()) {
    WARN("skipped: a sanitizer owns the allocator");
    return;
  }
  REQUIRE(AllocationHookSeesAll());
  NetworkSpec s = kPi;
  s.layers = 8;
  s.hidden = s.input_linear = 128;
  s.skip = true;
  const WeightsFile w = MakeRandomWeights(s, 14);
  const Eigen::MatrixXf X = Inputs(s.input, 20, 15);
  for (const WeightFormat format : {WeightFormat::kFp32, WeightFormat::k16, WeightFormat::k8}) {
    Network net(w, "net", {.format = format});
    const GaussianHead a(net, "a");
    std::vector<float> state(net.state_size());
    float sum = 0;
    const AllocationCounter counter;
    for (int t = 0; t < 20; ++t) {
      if (t == 10) net.Reset();
      if (net.Step(X.col(t).data()) != Status::kOk) break;
      net.SaveState(state.data());
      net.RestoreState(state.data());
      sum += a.Mean(net).sum();
    }
    const int64_t n = counter.count();
    CHECK(n == 0);
    CHECK(sum != 0);
  }
}

TEST_CASE("Sequence after warm-up and Batch do not allocate, in any weight format") {
  if (!AllocationHookActive()) {
    WARN("skipped: a sanitizer owns the allocator");
    return;
  }
  REQUIRE(AllocationHookSeesAll());
  for (const WeightFormat format : {WeightFormat::kFp32, WeightFormat::k16, WeightFormat::k8}) {
    for (const bool bidirectional : {false, true}) {
      NetworkSpec s = kPi;
      s.bidirectional = bidirectional;
      s.layer_norm = s.skip = s.pool_mean = true;
      Network net(MakeRandomWeights(s, 16), "net", {.format = format});
      const RowMatrixXf X = Inputs(300, s.input, 17);
      std::vector<RowMatrixXf> heads;
      const auto run = [&](int T) {
        const AllocationCounter counter;
        for (const int threads : {1, 2}) {
          net.Sequence(X.topRows(T), heads, threads);
          net.EncodeFinal(X.topRows(T), threads);
        }
        return counter.count();
      };
      CHECK(run(300) > 0);  // the warm-up does, which also shows that the counter counts here
      CHECK(run(300) == 0);
      net.EncodeFinal(X.topRows(150));
      const AllocationCounter counter;
      net.EncodeFinal(X.topRows(290));
      const int64_t n = counter.count();
      CHECK(n == 0);
    }
    const Network net(MakeRandomWeights(kPi, 18), "net", {.format = format});
    NetworkBatch batch(net, 13);
    const RowMatrixXf X = Inputs(13, kPi.input, 19);
    std::vector<float> state(net.state_size());
    Status status = Status::kOk;
    const AllocationCounter counter;
    for (int t = 0; t < 10 && status == Status::kOk; ++t) {
      status = batch.Step(X.data());
      batch.SaveState(3, state.data());
      batch.RestoreState(7, state.data());
    }
    batch.Reset();
    const int64_t n = counter.count();
    CHECK(n == 0);
    CHECK(status == Status::kOk);
  }
}

TEST_CASE("A batch refuses what it cannot run") {
  NetworkSpec s = kPi;
  CHECK_THROWS_WITH(NetworkBatch(Network(MakeRandomWeights(s, 1), "net"), 0),
                    "a batch needs at least one rollout, not 0");
  NetworkBatch batch(Network(MakeRandomWeights(s, 1), "net"), 2);
  RowMatrixXf X = RowMatrixXf::Zero(2, s.input);
  X(1, 3) = std::numeric_limits<float>::quiet_NaN();
  CHECK(batch.Step(X.data()) == Status::kInvalidInput);
  s.bidirectional = true;
  CHECK_THROWS_WITH(NetworkBatch(Network(MakeRandomWeights(s, 1), "net"), 2),
                    "network \"net\" is bidirectional: it has no tick, and no batch");
}

TEST_CASE("The manifest chooses the weight format, and the caller may choose another") {
  NetworkSpec s = kPi;
  s.format = WeightFormat::k8;
  s.hidden = 128;
  const WeightsFile w = MakeRandomWeights(s, 20);
  const Network eight(w, "net"), full(w, "net", {.format = WeightFormat::kFp32});
  CHECK(eight.spec().format == WeightFormat::k8);
  CHECK(full.spec().format == WeightFormat::kFp32);
  CHECK(eight.weight_bytes() < full.weight_bytes() / 2);
}
