// What a network's linear heads mean. Views: they hold indices and read the outputs of the network they are
// given, which must be the one (or a copy of the one) they were made for. All but the constructors is
// real-time safe.
#pragma once

#include <Eigen/Core>
#include <cmath>
#include <string>

#include "intabs/nn/network.h"

namespace intabs {

// Diagonal normal of heads NAME_mean and NAME_log_std; without the latter a fixed log standard deviation.
class GaussianHead {
 public:
  GaussianHead(const Network& net, const std::string& name, float fixed_log_std = 0)
      : mean_(net.HeadIndex(name + "_mean")),
        log_std_(net.HasHead(name + "_log_std") ? net.HeadIndex(name + "_log_std") : -1),
        fixed_(Eigen::VectorXf::Constant(net.head_size(mean_), fixed_log_std)) {
    if (log_std_ >= 0 && net.head_size(log_std_) != size()) {
      throw std::runtime_error("heads \"" + name + "_mean\" and \"" + name + "_log_std\" differ in size: " +
                               std::to_string(size()) + " and " + std::to_string(net.head_size(log_std_)));
    }
  }

  int size() const noexcept { return static_cast<int>(fixed_.size()); }
  Eigen::Map<const Eigen::VectorXf> Mean(const Network& net) const noexcept { return net.Head(mean_); }
  Eigen::Map<const Eigen::VectorXf> LogStd(const Network& net) const noexcept {
    return log_std_ >= 0 ? net.Head(log_std_)
                         : Eigen::Map<const Eigen::VectorXf>(fixed_.data(), fixed_.size());
  }

 private:
  int mean_;
  int log_std_;
  Eigen::VectorXf fixed_;
};

// Probability of 1 from head NAME, a single logit.
class BernoulliHead {
 public:
  BernoulliHead(const Network& net, const std::string& name) : logit_(net.HeadIndex(name)) {
    if (net.head_size(logit_) != 1) {
      throw std::runtime_error("head \"" + name + "\" has size " + std::to_string(net.head_size(logit_)) +
                               ", a Bernoulli head has 1");
    }
  }

  float Logit(const Network& net) const noexcept { return net.Head(logit_)[0]; }
  float Probability(const Network& net) const noexcept { return 1.0f / (1.0f + std::exp(-Logit(net))); }

 private:
  int logit_;
};

}  // namespace intabs
