"""The terms of the objective, one small function each."""

from __future__ import annotations

import torch
from torch import Tensor


def action_error(predicted: Tensor, target: Tensor) -> Tensor:
    """-log N(a; mu, sigma^2 I) up to scale and constant, mean over ticks and dimensions. (B, T, n) -> ()."""
    return ((predicted - target) ** 2).mean()


def kl_to_standard_normal(mean: Tensor, log_std: Tensor) -> Tensor:
    """KL(N(mean, std^2) || N(0, I)) summed over z, mean over segments [nat] (Kingma & Welling 2014, appendix B)."""
    return (0.5 * (mean**2 + torch.exp(2 * log_std) - 1) - log_std).sum(-1).mean()
