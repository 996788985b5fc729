#include "intabs/nn/network.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

namespace intabs {
namespace {

// One column from outside to where the kernels can read it.
void CopyColumn(const float* from, int n, float* to) noexcept { std::copy_n(from, n, to); }

bool AllFinite(const float* x, ptrdiff_t n) noexcept {
  // x * 0 is 0, or NaN for NaN and infinity; unlike a branch each, this is one pass of vectors.
  float sum = 0;
  for (ptrdiff_t i = 0; i < n; ++i) sum += x[i] * 0.0f;
  return sum == 0.0f;
}

ptrdiff_t LinearWidth(const Cell& cell) { return static_cast<ptrdiff_t>(cell.panels) * kPanelGates; }

void EnsureSize(AlignedFloats& a, size_t n) {
  if (a.size() < n) a.resize(n);
}

}  // namespace

Network Network::Load(const std::string& dir, const std::string& name, const NetworkOptions& options) {
  return Network(WeightsFile::Load(dir), name, options);
}

Network::Network(const WeightsFile& file, const std::string& name, const NetworkOptions& options)
    : name_(name),
      spec_(file.manifest().network(name)),
      lstm_(file, name, options.format.value_or(spec_.format), options.isa),
      kernels_(lstm_.stack().kernels) {
  spec_.format = options.format.value_or(spec_.format);
  if (spec_.input_linear > 0) {
    input_.AddLinear(file.tensor(name + ".input.weight"), file.tensor(name + ".input.bias"));
    linear_.resize(LinearWidth(input_.cell(0)));
  }
  int rows = 0;
  for (const HeadSpec& h : spec_.heads) {
    head_offset_.push_back(rows);
    rows += h.size;
  }
  RowMatrixXf weight(rows, spec_.head_input()), bias(rows, 1);
  for (int i = 0; i < num_heads(); ++i) {
    const std::string prefix = name + ".heads." + head_name(i);
    weight.middleRows(head_offset_[i], head_size(i)) = file.tensor(prefix + ".weight");
    bias.middleRows(head_offset_[i], head_size(i)) = file.tensor(prefix + ".bias");
  }
  heads_.AddLinear(weight, bias);
  head_out_.resize(heads_ld());
  x_.resize(spec_.input);
  top_.resize(spec_.head_input());
  scratch_.resize(kernels_->scratch_bytes(std::max(spec_.input, spec_.head_input()), 1) / sizeof(float) + 16);
}

size_t Network::weight_bytes() const { return input_.bytes() + lstm_.stack().cells.bytes() + heads_.bytes(); }

bool Network::HasHead(std::string_view name) const noexcept {
  return std::any_of(spec_.heads.begin(), spec_.heads.end(),
                     [&](const HeadSpec& h) { return h.name == name; });
}

int Network::HeadIndex(std::string_view name) const {
  std::string known;
  for (int i = 0; i < num_heads(); ++i) {
    if (head_name(i) == name) return i;
    known += (i > 0 ? ", " : "") + head_name(i);
  }
  throw std::runtime_error("network \"" + name_ + "\" has no head \"" + std::string(name) + "\"; it has " +
                           known);
}

ptrdiff_t Network::heads_ld() const noexcept { return LinearWidth(heads_.cell(0)); }

void Network::Heads(const float* top, ptrdiff_t ld, int n, float* out, void* scratch) const noexcept {
  kernels_->input_gates(heads_.cell(0), top, ld, n, out, scratch);
}

Status Network::Step(const float* x) noexcept {
  if (spec_.bidirectional) return Status::kNotReady;
  if (!AllFinite(x, spec_.input)) return Status::kInvalidInput;
  CopyColumn(x, spec_.input, x_.data());
  const float* in = x_.data();
  if (input_.size() > 0) {
    kernels_->input_gates(input_.cell(0), in, static_cast<ptrdiff_t>(x_.size()), 1, linear_.data(),
                          scratch_.data());
    in = linear_.data();
  }
  const float* top = lstm_.Step(in);
  if (spec_.skip) {
    CopyColumn(top, spec_.layer_output(), top_.data());
    CopyColumn(x, spec_.input, top_.data() + spec_.layer_output());
    top = top_.data();
  }
  Heads(top, 0, 1, head_out_.data(), scratch_.data());
  return Status::kOk;
}

void Network::Reset() noexcept { lstm_.Reset(); }
int Network::state_size() const { return spec_.bidirectional ? 0 : lstm_.state_size(); }
void Network::SaveState(float* out) const noexcept {
  if (!spec_.bidirectional) lstm_.SaveState(out);
}
void Network::RestoreState(const float* in) noexcept {
  if (!spec_.bidirectional) lstm_.RestoreState(in);
}

const float* Network::Top(const Eigen::Ref<const RowMatrixXf>& X, int threads) {
  if (X.cols() != spec_.input || X.rows() < 1) {
    throw std::invalid_argument("network \"" + name_ + "\": the sequence is " + std::to_string(X.rows()) +
                                "x" + std::to_string(X.cols()) + ", wanted Tx" + std::to_string(spec_.input) +
                                ", T >= 1");
  }
  const int T = static_cast<int>(X.rows());
  const ptrdiff_t ld = RoundUp(spec_.input, 16);
  EnsureSize(seq_x_, T * ld);
  for (int t = 0; t < T; ++t) CopyColumn(X.row(t).data(), spec_.input, seq_x_.data() + t * ld);
  const int longest = std::max({spec_.input, spec_.lstm_input(), spec_.head_input()});
  EnsureSize(seq_scratch_, kernels_->scratch_bytes(longest, T) / sizeof(float) + 16);
  const float* top;
  if (input_.size() == 0) {
    top = lstm_.Sequence(seq_x_.data(), ld, T, threads);
  } else {
    const ptrdiff_t ld_linear = LinearWidth(input_.cell(0));
    EnsureSize(seq_linear_, T * ld_linear);
    kernels_->input_gates(input_.cell(0), seq_x_.data(), ld, T, seq_linear_.data(), seq_scratch_.data());
    top = lstm_.Sequence(seq_linear_.data(), ld_linear, T, threads);
  }
  if (!spec_.skip) return top;
  EnsureSize(seq_top_, T * head_ld());
  for (int t = 0; t < T; ++t) {
    float* to = seq_top_.data() + t * head_ld();
    CopyColumn(top + t * lstm_.ld_out(), spec_.layer_output(), to);
    CopyColumn(seq_x_.data() + t * ld, spec_.input, to + spec_.layer_output());
  }
  return seq_top_.data();
}

ptrdiff_t Network::head_ld() const noexcept {
  return spec_.skip ? RoundUp(spec_.head_input(), 16) : lstm_.ld_out();
}

void Network::Sequence(const Eigen::Ref<const RowMatrixXf>& X, std::vector<RowMatrixXf>& heads, int threads) {
  const float* top = Top(X, threads);
  const int T = static_cast<int>(X.rows());
  EnsureSize(seq_heads_, T * heads_ld());
  Heads(top, head_ld(), T, seq_heads_.data(), seq_scratch_.data());
  heads.resize(num_heads());
  for (int i = 0; i < num_heads(); ++i) {
    heads[i] = Eigen::Map<const RowMatrixXf, 0, Eigen::OuterStride<>>(
        seq_heads_.data() + head_offset_[i], T, head_size(i), Eigen::OuterStride<>(heads_ld()));
  }
}

void Network::EncodeFinal(const Eigen::Ref<const RowMatrixXf>& X, int threads) {
  const float* top = Top(X, threads);
  const ptrdiff_t T = X.rows();
  if (spec_.pool_mean) {  // heads are linear: the mean of what they read gives the mean of what they say
    const Eigen::Map<const Eigen::MatrixXf, 0, Eigen::OuterStride<>> columns(top, spec_.head_input(), T,
                                                                             Eigen::OuterStride<>(head_ld()));
    Eigen::Map<Eigen::VectorXf>(top_.data(), spec_.head_input()) = columns.rowwise().mean();
  } else {
    std::copy_n(top + (T - 1) * head_ld(), spec_.head_input(), top_.data());
    if (spec_.bidirectional) std::copy_n(top + spec_.hidden, spec_.hidden, top_.data() + spec_.hidden);
  }
  Heads(top_.data(), 0, 1, head_out_.data(), scratch_.data());
}

// ------------------------------------------------------------------------------------------------------
// NetworkBatch

NetworkBatch::NetworkBatch(const Network& net, int n) : net_(net), lstm_(net.lstm_.stack(), std::max(n, 1)) {
  if (n < 1) throw std::invalid_argument("a batch needs at least one rollout, not " + std::to_string(n));
  if (net.spec().bidirectional) {
    throw std::invalid_argument("network \"" + net.name_ +
                                "\" is bidirectional: it has no tick, and no batch");
  }
  x_.resize(static_cast<size_t>(n) * RoundUp(net.input_size(), 16));
  if (net.input_.size() > 0) linear_.resize(n * LinearWidth(net.input_.cell(0)));
  head_out_.resize(n * net.heads_ld());
  if (net.spec().skip) top_.resize(n * net.head_ld());
  const int longest = std::max({net.spec().input, net.spec().lstm_input(), net.spec().head_input()});
  scratch_.resize(net.kernels_->scratch_bytes(longest, n) / sizeof(float) + 16);
}

Status NetworkBatch::Step(const float* X) noexcept {
  const int inputs = net_.input_size();
  if (!AllFinite(X, static_cast<ptrdiff_t>(size()) * inputs)) return Status::kInvalidInput;
  ptrdiff_t ld = RoundUp(inputs, 16);
  for (int j = 0; j < size(); ++j)
    CopyColumn(X + static_cast<ptrdiff_t>(j) * inputs, inputs, x_.data() + j * ld);
  const float* in = x_.data();
  if (net_.input_.size() > 0) {
    net_.kernels_->input_gates(net_.input_.cell(0), in, ld, size(), linear_.data(), scratch_.data());
    in = linear_.data();
    ld = LinearWidth(net_.input_.cell(0));
  }
  const float* top = lstm_.Step(in, ld);
  ptrdiff_t ld_top = lstm_.ld_out();
  if (net_.spec_.skip) {
    for (int j = 0; j < size(); ++j) {
      float* to = top_.data() + j * net_.head_ld();
      CopyColumn(top + j * ld_top, net_.spec_.layer_output(), to);
      CopyColumn(X + static_cast<ptrdiff_t>(j) * inputs, inputs, to + net_.spec_.layer_output());
    }
    top = top_.data();
    ld_top = net_.head_ld();
  }
  net_.Heads(top, ld_top, size(), head_out_.data(), scratch_.data());
  return Status::kOk;
}

void NetworkBatch::Reset() noexcept { lstm_.Reset(); }
void NetworkBatch::SaveState(int j, float* out) const noexcept { lstm_.SaveState(j, out); }
void NetworkBatch::RestoreState(int j, const float* in) noexcept { lstm_.RestoreState(j, in); }

}  // namespace intabs
