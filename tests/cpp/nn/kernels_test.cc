// Every instruction set and weight format against plain Eigen in double, also those that this CPU would not
// choose.
#include "intabs/nn/kernels.h"

#include <bit>
#include <catch2/catch.hpp>
#include <cmath>
#include <limits>

#include "intabs/nn/network.h"
#include "intabs/nn/reference.h"
#include "nn/random_weights.h"

using namespace intabs;

namespace {

std::vector<Isa> SupportedIsas() {
  std::vector<Isa> out;
  for (const Isa isa : kAllIsas) {
    if (IsSupported(isa)) {
      out.push_back(isa);
    } else {
      WARN("skipped: " << Name(isa) << ", this CPU lacks it");
    }
  }
  return out;
}

struct Activation {
  const char* name;
  void (*Kernels::*function)(const float*, float*, int) noexcept;
  double (*reference)(double);
  bool in_ulp;
  double bound;
};
const Activation kActivations[] = {
    {"exp", &Kernels::exp, [](double x) { return std::exp(x); }, true, kExpMaxUlp},
    {"tanh", &Kernels::tanh, [](double x) { return std::tanh(x); }, true, kTanhMaxUlp},
    {"sigmoid", &Kernels::sigmoid, [](double x) { return 1 / (1 + std::exp(-x)); }, false, kSigmoidMaxError},
};

// Error in units of the last place of a float at `want`; an infinity where `want` rounds to it is right.
double Ulp(float got, double want) {
  if (std::isinf(got)) return std::isinf(static_cast<float>(want)) && (got > 0) == (want > 0) ? 0 : 1e9;
  int exponent = 0;
  std::frexp(want, &exponent);
  return std::abs(got - want) / std::ldexp(1.0, std::max(exponent - 24, -149));
}

RowMatrixXf Trajectory(int T, int n, unsigned seed) {
  std::mt19937 rng(seed);
  std::normal_distribution<float> normal;
  return RowMatrixXf::NullaryExpr(T, n, [&] { return normal(rng); });
}

// Rounds every LSTM weight to what the format can hold, so that packing loses nothing and what remains is the
// kernels'.
RawTensors Representable(RawTensors tensors, WeightFormat format) {
  for (auto& [name, t] : tensors) {
    if (name.find(".lstm.") == std::string::npos || name.find("weight_") == std::string::npos) continue;
    const size_t cols = static_cast<size_t>(t.shape[1]);
    std::vector<float> v(t.bytes.size() / 4);
    std::memcpy(v.data(), t.bytes.data(), t.bytes.size());
    for (size_t row = 0; row < v.size(); row += cols) {
      float largest = 0;
      for (size_t k = 0; k < cols; ++k) largest = std::max(largest, std::abs(v[row + k]));
      for (size_t k = 0; k < cols; ++k) {
        float& w = v[row + k];
        if (format == WeightFormat::k16) w = std::bit_cast<float>(std::bit_cast<uint32_t>(w) & 0xffff0000);
        if (format == WeightFormat::k8 && largest > 0) w = std::round(w / largest * 127) * (largest / 127);
      }
    }
    std::memcpy(t.bytes.data(), v.data(), t.bytes.size());
  }
  return tensors;
}

double Difference(const std::vector<ReferenceNetwork<double>::Rows>& want,
                  const std::vector<RowMatrixXf>& got) {
  double worst = 0;
  for (size_t i = 0; i < want.size(); ++i) {
    worst = std::max(worst, (want[i] - got[i].cast<double>()).cwiseAbs().maxCoeff());
  }
  return worst;
}

// What a format costs beyond the rounding of its weights: 8 bit takes inputs of 16 bit, and bf16 products
// round the inputs to 8 bits of mantissa (many columns, with BF16 instructions).
double Bound(WeightFormat format, Isa isa, bool columns) {
  if (format == WeightFormat::k16 && isa == Isa::kAvx512Vnni && columns) return 3e-2;
  if (format == WeightFormat::k8) return 5e-4;
  return 1e-5;
}

struct Shape {
  int input, input_linear, layers, hidden;
  bool residual, layer_norm;
};
// Odd sizes, sizes below a panel, whole panels; every option.
const Shape kShapes[] = {{1, 0, 1, 1, false, false},     {3, 0, 2, 5, true, false},
                         {7, 9, 3, 16, true, true},      {33, 0, 2, 24, false, true},
                         {40, 128, 3, 128, true, false}, {130, 0, 2, 100, true, false},
                         {32, 0, 8, 128, false, false},  {5, 21, 4, 47, true, true}};

}  // namespace

TEST_CASE("Activations keep their stated error over the whole range, in every instruction set") {
  for (const Isa isa : SupportedIsas()) {
    for (const Activation& a : kActivations) {
      const auto function = KernelsFor(isa).*a.function;
      double worst = 0;
      float at = 0;
      std::vector<float> x, y(4096);
      const auto flush = [&] {
        function(x.data(), y.data(), static_cast<int>(x.size()));
        for (size_t i = 0; i < x.size(); ++i) {
          const double want = a.reference(x[i]);
          const double error = a.in_ulp ? Ulp(y[i], want) : std::abs(y[i] - want);
          if (!(error <= worst)) worst = error, at = x[i];
        }
        x.clear();
      };
      for (uint64_t bits = 0; bits < uint64_t{1} << 32; bits += 2003) {
        const float v = std::bit_cast<float>(static_cast<uint32_t>(bits));
        if (!std::isnan(v)) x.push_back(v);
        if (x.size() == y.size()) flush();
      }
      flush();
      INFO(Name(isa) << " " << a.name << ": " << worst << " at " << at);
      CHECK(worst <= a.bound);
    }
  }
}

TEST_CASE("Activations know the ends, pass NaN on, and work in place on any length") {
  const float inf = std::numeric_limits<float>::infinity(), nan = std::numeric_limits<float>::quiet_NaN();
  for (const Isa isa : SupportedIsas()) {
    INFO(Name(isa));
    const Kernels& k = KernelsFor(isa);
    for (const Activation& a : kActivations) {
      for (int n = 0; n < 50; ++n) {
        std::vector<float> x(n + 1, 0.5f);
        if (n > 0) x[n / 2] = nan;
        x[n] = 7;  // must stay
        (k.*a.function)(x.data(), x.data(), n);
        for (int i = 0; i < n; ++i) REQUIRE(std::isnan(x[i]) == (i == n / 2));
        REQUIRE(x[n] == 7);
      }
    }
    float v[] = {inf, -inf, 0.0f, -0.0f, 200, -200};
    k.exp(v, v, 6);
    CHECK((v[0] == inf && v[1] == 0 && v[2] == 1 && v[3] == 1 && v[4] == inf && v[5] == 0));
    float t[] = {inf, -inf, 0.0f, 200, -200};
    k.tanh(t, t, 5);
    CHECK((t[0] == 1 && t[1] == -1 && t[2] == 0 && t[3] == 1 && t[4] == -1));
    float s[] = {inf, -inf, 0.0f, 200};
    k.sigmoid(s, s, 4);
    CHECK((s[0] == 1 && s[1] < 1e-37f && s[2] == 0.5f && s[3] == 1));
  }
}

TEST_CASE("Step and Sequence of every path agree with Eigen in double") {
  for (const WeightFormat format : {WeightFormat::kFp32, WeightFormat::k16, WeightFormat::k8}) {
    for (size_t k = 0; k < std::size(kShapes); ++k) {
      const Shape& s = kShapes[k];
      const NetworkSpec spec{.input = s.input,
                             .input_linear = s.input_linear,
                             .layers = s.layers,
                             .hidden = s.hidden,
                             .residual = s.residual,
                             .layer_norm = s.layer_norm,
                             .skip = k % 2 == 1,
                             .heads = {{"a", 70}, {"b", 1}}};
      const WeightsFile w =
          MakeWeights({{"net", spec}}, Representable(RandomNetwork("net", spec, 100 + k, 2), format));
      const RowMatrixXf X = Trajectory(60, s.input, 7);
      std::vector<ReferenceNetwork<double>::Rows> want;
      ReferenceNetwork<double>(w, "net").Sequence(X.cast<double>(), want);
      for (const Isa isa : SupportedIsas()) {
        Network net(w, "net", {.format = format, .isa = isa});
        INFO(Name(isa) << ", format " << static_cast<int>(format) << ", shape " << k);
        std::vector<RowMatrixXf> sequence, steps = {RowMatrixXf(60, 70), RowMatrixXf(60, 1)};
        net.Sequence(X, sequence);
        CHECK(Difference(want, sequence) <= Bound(format, isa, true));
        for (int t = 0; t < 60; ++t) {
          REQUIRE(net.Step(X.row(t).data()) == Status::kOk);
          for (int i = 0; i < 2; ++i) steps[i].row(t) = net.Head(i).transpose();
        }
        CHECK(Difference(want, steps) <= Bound(format, isa, false));
      }
    }
  }
}

TEST_CASE(
    "A bidirectional sequence of every path agrees with Eigen in double, with one thread and with two") {
  for (const WeightFormat format : {WeightFormat::kFp32, WeightFormat::k16, WeightFormat::k8}) {
    for (const bool norm : {false, true}) {
      const NetworkSpec spec{.input = 11,
                             .layers = 3,
                             .hidden = 40,
                             .residual = true,
                             .bidirectional = true,
                             .layer_norm = norm,
                             .skip = norm,
                             .heads = {{"a", 3}}};
      const WeightsFile w =
          MakeWeights({{"net", spec}}, Representable(RandomNetwork("net", spec, 5, 2), format));
      for (const int T : {1, 2, 6, 7, 50}) {
        const RowMatrixXf X = Trajectory(T, 11, T);
        std::vector<ReferenceNetwork<double>::Rows> want;
        ReferenceNetwork<double>(w, "net").Sequence(X.cast<double>(), want);
        for (const Isa isa : SupportedIsas()) {
          Network net(w, "net", {.format = format, .isa = isa});
          INFO(Name(isa) << ", format " << static_cast<int>(format) << ", T " << T << ", norm " << norm);
          std::vector<RowMatrixXf> one, two;
          net.Sequence(X, one, 1);
          CHECK(Difference(want, one) <= Bound(format, isa, true));
          net.Sequence(X, two, 2);
          CHECK(one[0] == two[0]);
        }
      }
    }
  }
}

TEST_CASE("A batch of every path agrees with Eigen in double, each rollout with a state of its own") {
  const NetworkSpec spec{.input = 13,
                         .input_linear = 30,
                         .layers = 3,
                         .hidden = 48,
                         .residual = true,
                         .layer_norm = true,
                         .skip = true,
                         .heads = {{"a", 7}, {"b", 2}}};
  for (const WeightFormat format : {WeightFormat::kFp32, WeightFormat::k16, WeightFormat::k8}) {
    const WeightsFile w =
        MakeWeights({{"net", spec}}, Representable(RandomNetwork("net", spec, 6, 2), format));
    for (const int n : {1, 3, 6, 11, 64}) {
      const int T = 20;
      std::vector<RowMatrixXf> X;
      std::vector<std::vector<ReferenceNetwork<double>::Rows>> want(n);
      ReferenceNetwork<double> reference(w, "net");
      for (int j = 0; j < n; ++j) {
        X.push_back(Trajectory(T, 13, 1000 * n + j));
        reference.Sequence(X[j].cast<double>(), want[j]);
      }
      for (const Isa isa : SupportedIsas()) {
        INFO(Name(isa) << ", format " << static_cast<int>(format) << ", n " << n);
        const Network net(w, "net", {.format = format, .isa = isa});
        NetworkBatch batch(net, n);
        std::vector<float> state(net.state_size());
        double worst = 0;
        RowMatrixXf rows(n, 13);
        for (int t = 0; t < T; ++t) {
          for (int j = 0; j < n; ++j) rows.row(j) = X[j].row(t);
          REQUIRE(batch.Step(rows.data()) == Status::kOk);
          for (int i = 0; i < 2; ++i) {
            for (int j = 0; j < n; ++j) {
              worst = std::max(
                  worst, (batch.Head(i).row(j).cast<double>() - want[j][i].row(t)).cwiseAbs().maxCoeff());
            }
          }
        }
        CHECK(worst <= Bound(format, isa, true));
        // The state of one goes into a network of its own, and on from there.
        Network single = net;
        batch.SaveState(n - 1, state.data());
        single.RestoreState(state.data());
        REQUIRE(single.Step(rows.row(0).data()) == Status::kOk);
        for (int j = 0; j < n; ++j) rows.row(j) = rows.row(0);
        batch.RestoreState(0, state.data());
        REQUIRE(batch.Step(rows.data()) == Status::kOk);
        CHECK((batch.Head(0).row(0) - single.Head(0).transpose()).cwiseAbs().maxCoeff() <=
              Bound(format, isa, true));
        CHECK((batch.Head(0).row(0) - batch.Head(0).row(n - 1)).cwiseAbs().maxCoeff() <= 1e-6f);
        batch.Reset();
        REQUIRE(batch.Step(rows.data()) == Status::kOk);
        single.Reset();
        REQUIRE(single.Step(rows.row(0).data()) == Status::kOk);
        CHECK((batch.Head(1).row(0) - single.Head(1).transpose()).cwiseAbs().maxCoeff() <=
              Bound(format, isa, true));
      }
    }
  }
}

TEST_CASE("Weights of very different size keep their own scale in 8 bit, and zero rows stay zero") {
  const NetworkSpec spec{.input = 4, .layers = 1, .hidden = 16, .heads = {{"a", 1}}};
  RawTensors tensors = RandomNetwork("net", spec, 3);
  RawTensor& w_ih = tensors["net.lstm.0.weight_ih"];
  std::vector<float> v(w_ih.bytes.size() / 4);
  for (size_t i = 0; i < v.size(); ++i) {
    const float magnitude[] = {0.0f, 1e-30f, 1e-3f, 30.0f};
    v[i] = magnitude[i / 4 % 4] * static_cast<float>(127 - 2 * (i % 4)) / 127;
  }
  std::memcpy(w_ih.bytes.data(), v.data(), w_ih.bytes.size());
  const WeightsFile w = MakeWeights({{"net", spec}}, Representable(tensors, WeightFormat::k8));
  const RowMatrixXf X = Trajectory(30, 4, 9);
  std::vector<ReferenceNetwork<double>::Rows> want;
  ReferenceNetwork<double>(w, "net").Sequence(X.cast<double>(), want);
  for (const Isa isa : SupportedIsas()) {
    INFO(Name(isa));
    Network net(w, "net", {.format = WeightFormat::k8, .isa = isa});
    std::vector<RowMatrixXf> got;
    net.Sequence(X, got);
    CHECK(Difference(want, got) <= 1e-3);
  }
}

TEST_CASE("An unknown weight format is refused by name") {
  CHECK_THROWS_WITH(ParseWeightFormat("4"),
                    "weight format \"4\" is unknown; there are \"fp32\", \"16\" and \"8\"");
}
