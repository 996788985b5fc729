#include "intabs/nn/fast_lstm.h"

#include <algorithm>
#include <cmath>
#include <cstring>

namespace intabs {

LstmStack::LstmStack(const WeightsFile& file, const std::string& net, WeightFormat format, Isa isa)
    : spec(file.manifest().network(net)), kernels(&KernelsFor(isa)) {
  for (int l = 0; l < spec.layers; ++l) {
    const std::string prefix = net + ".lstm." + std::to_string(l) + ".";
    for (const char* end : {"", "_reverse"}) {
      if (*end != 0 && !spec.bidirectional) continue;
      cells.AddLstm(file.tensor(prefix + "weight_ih" + end), file.tensor(prefix + "weight_hh" + end),
                    file.tensor(prefix + "bias_ih" + end), file.tensor(prefix + "bias_hh" + end), format);
    }
    if (spec.layer_norm) {
      norm_weight.emplace_back();
      norm_bias.emplace_back();
      if (l == 0) continue;
      const RowMatrixXf& weight = file.tensor(prefix + "norm.weight");
      const RowMatrixXf& bias = file.tensor(prefix + "norm.bias");
      norm_weight.back().resize(weight.size());
      norm_bias.back().resize(bias.size());
      std::copy_n(weight.data(), weight.size(), norm_weight.back().data());
      std::copy_n(bias.data(), bias.size(), norm_bias.back().data());
    }
  }
}

void LstmStack::Normalise(int layer, const float* in, float* out) const noexcept {
  const int n = spec.layer_output();
  const float* weight = norm_weight[layer].data();
  const float* bias = norm_bias[layer].data();
  double sum = 0, squares = 0;
  for (int k = 0; k < n; ++k) sum += in[k];
  const double mean = sum / n;
  for (int k = 0; k < n; ++k) squares += (in[k] - mean) * (in[k] - mean);
  const float scale = static_cast<float>(1.0 / std::sqrt(squares / n + kLayerNormEpsilon));
  const float centre = static_cast<float>(mean);
  for (int k = 0; k < n; ++k) out[k] = (in[k] - centre) * scale * weight[k] + bias[k];
}

// ----------------------------------------------------------------------------------------------------------
// FastLstm

FastLstm::FastLstm(const WeightsFile& file, const std::string& net, WeightFormat format, Isa isa)
    : stack_(file, net, format, isa) {
  const size_t states = static_cast<size_t>(stack_.num_layers()) * stack_.padded_hidden();
  h_[0].resize(states);
  h_[1].resize(states);
  c_.resize(states);
  x_.resize(stack_.padded_width());
  normalised_.resize(stack_.padded_width());
  gates_.resize(4 * stack_.padded_hidden());
  scratch_.resize(stack_.kernels->scratch_bytes(stack_.padded_width(), 1) / sizeof(float) + 16);
}

const float* FastLstm::Step(const float* x) noexcept {
  const int hidden = stack_.spec.hidden, padded = stack_.padded_hidden();
  const float* h = h_[now_].data();
  float* h_new = h_[1 - now_].data();
  float* c = c_.data();
  for (int l = 0; l < stack_.num_layers(); ++l, h += padded, h_new += padded, c += padded) {
    const float* in = x;
    if (stack_.spec.layer_norm && l > 0) {
      stack_.Normalise(l, x, normalised_.data());
      in = normalised_.data();
    }
    stack_.kernels->step(stack_.cell(l), in, h, h_new, c, gates_.data(), scratch_.data());
    if (stack_.spec.residual && l > 0) {
      float* sum = x_.data();
      for (int k = 0; k < hidden; ++k) sum[k] = x[k] + h_new[k];
      x = sum;
    } else {
      x = h_new;
    }
  }
  now_ = 1 - now_;
  return x;
}

void FastLstm::Reset() noexcept {
  h_[now_].SetZero();
  c_.SetZero();
}

void FastLstm::SaveState(float* out) const noexcept {
  for (const float* from : {h_[now_].data(), c_.data()}) {
    for (int l = 0; l < stack_.num_layers(); ++l) {
      out = std::copy_n(from + static_cast<ptrdiff_t>(l) * stack_.padded_hidden(), stack_.spec.hidden, out);
    }
  }
}

void FastLstm::RestoreState(const float* in) noexcept {
  for (float* to : {h_[now_].data(), c_.data()}) {
    for (int l = 0; l < stack_.num_layers(); ++l, in += stack_.spec.hidden) {
      std::copy_n(in, stack_.spec.hidden, to + static_cast<ptrdiff_t>(l) * stack_.padded_hidden());
    }
  }
}

void FastLstm::Directions(int layer, int first, int last, const float* in, ptrdiff_t ld_in, const float* X,
                          ptrdiff_t ld, int T, float* Y) noexcept {
  const int hidden = stack_.spec.hidden;
  const bool residual = stack_.spec.residual && layer > 0;
  const ptrdiff_t padded = stack_.padded_hidden(), ldg = padded * 4;
  for (int i = first; i <= last; ++i) {
    auto& d = sequence_.direction[i];
    stack_.kernels->input_gates(stack_.cell(layer, i), in, ld_in, T, d.gates.data(), d.scratch.data());
    d.h.SetZero();
    d.c.SetZero();
  }
  for (int tick = 0; tick < T; ++tick) {
    const ptrdiff_t before = tick % 2 * padded, after = padded - before;
    for (int i = first; i <= last; ++i) {
      auto& d = sequence_.direction[i];
      const ptrdiff_t t = i == 0 ? tick : T - 1 - tick;
      const float* h = d.h.data() + after;
      stack_.kernels->step_from_gates(stack_.cell(layer, i), d.gates.data() + t * ldg, d.h.data() + before,
                                      d.h.data() + after, d.c.data(), d.scratch.data());
      float* y = Y + t * ld_out() + i * hidden;
      if (residual) {
        const float* x = X + t * ld + i * hidden;
        for (int k = 0; k < hidden; ++k) y[k] = h[k] + x[k];
      } else {
        std::copy_n(h, hidden, y);
      }
    }
  }
}

const float* FastLstm::Sequence(const float* X, ptrdiff_t ld, int T, int threads) {
  auto& s = sequence_;
  if (T > s.T) {
    const size_t columns = static_cast<size_t>(T), width = stack_.padded_width();
    for (auto& rows : s.rows) rows.resize(columns * width);
    if (stack_.spec.layer_norm) s.normalised.resize(columns * width);
    for (int i = 0; i < stack_.directions(); ++i) {
      auto& d = s.direction[i];
      d.gates.resize(columns * kPanelGates * stack_.cell(0).panels);
      d.h.resize(2 * stack_.padded_hidden());
      d.c.resize(stack_.padded_hidden());
      d.scratch.resize(stack_.kernels->scratch_bytes(stack_.padded_width(), T) / sizeof(float) + 16);
    }
    s.T = T;
  }
  for (int l = 0; l < stack_.num_layers(); ++l) {
    const float* in = X;
    ptrdiff_t ld_in = ld;
    if (stack_.spec.layer_norm && l > 0) {
      for (int t = 0; t < T; ++t) stack_.Normalise(l, X + t * ld, s.normalised.data() + t * ld_out());
      in = s.normalised.data();
      ld_in = ld_out();
    }
    float* Y = s.rows[l % 2].data();
    if (stack_.directions() == 2 && threads > 1) {
      second_.Run([&] { Directions(l, 0, 0, in, ld_in, X, ld, T, Y); },
                  [&] { Directions(l, 1, 1, in, ld_in, X, ld, T, Y); });
    } else {
      Directions(l, 0, stack_.directions() - 1, in, ld_in, X, ld, T, Y);
    }
    X = Y;
    ld = ld_out();
  }
  return X;
}

// ---------------------------------------------------------------------------------------------------------
// LstmBatch

LstmBatch::LstmBatch(const LstmStack& stack, int n) : stack_(stack), n_(n), ldh_(stack.padded_hidden()) {
  const size_t columns = static_cast<size_t>(n);
  for (AlignedFloats* state : {&h_[0], &h_[1], &c_}) state->resize(columns * ldh_ * stack_.num_layers());
  x_.resize(columns * stack_.padded_width());
  if (stack_.spec.layer_norm) normalised_.resize(columns * stack_.padded_width());
  gates_.resize(columns * kPanelGates);
  scratch_.resize(stack_.kernels->scratch_bytes(stack_.padded_width(), n) / sizeof(float) + 16);
}

const float* LstmBatch::Step(const float* X, ptrdiff_t ld) noexcept {
  const int hidden = stack_.spec.hidden;
  for (int l = 0; l < stack_.num_layers(); ++l) {
    const float* in = X;
    ptrdiff_t ld_in = ld;
    if (stack_.spec.layer_norm && l > 0) {
      for (int j = 0; j < n_; ++j) stack_.Normalise(l, X + j * ld, normalised_.data() + j * ld_out());
      in = normalised_.data();
      ld_in = ld_out();
    }
    float* h_new = h(1 - now_, l);
    stack_.kernels->batch(stack_.cell(l), in, ld_in, h(now_, l), h_new, c_.data() + l * n_ * ldh_, ldh_, n_,
                          gates_.data(), scratch_.data());
    float* out = x_.data();
    for (int j = 0; j < n_; ++j) {
      float* to = out + j * ld_out();
      const float* from = h_new + j * ldh_;
      if (stack_.spec.residual && l > 0) {
        for (int k = 0; k < hidden; ++k) to[k] += from[k];
      } else {
        std::copy_n(from, hidden, to);
      }
    }
    X = out;
    ld = ld_out();
  }
  now_ = 1 - now_;
  return X;
}

void LstmBatch::Reset() noexcept {
  h_[now_].SetZero();
  c_.SetZero();
}

void LstmBatch::SaveState(int j, float* out) const noexcept {
  for (const float* from : {h_[now_].data(), c_.data()}) {
    for (int l = 0; l < stack_.num_layers(); ++l) {
      out = std::copy_n(from + (static_cast<ptrdiff_t>(l) * n_ + j) * ldh_, stack_.spec.hidden, out);
    }
  }
}

void LstmBatch::RestoreState(int j, const float* in) noexcept {
  for (float* to : {h_[now_].data(), c_.data()}) {
    for (int l = 0; l < stack_.num_layers(); ++l, in += stack_.spec.hidden) {
      std::copy_n(in, stack_.spec.hidden, to + (static_cast<ptrdiff_t>(l) * n_ + j) * ldh_);
    }
  }
}

}  // namespace intabs
