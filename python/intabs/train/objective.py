"""The terms of the objective, one small function each."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, distributed

from intabs.evaluate.metrics import Scaling
from intabs.model import kinematics
from intabs.model.space import State

REACH, UNIT = 0.08, 0.02  # m
TURN_LENGTH = 0.1  # m/rad, as kTurnLength of skills/skill_player.h
FLIPPED = 0.03  # of the rollouts begin with the gripper the other way round


def mean_over(values: Tensor, mask: Tensor) -> Tensor:
    """Of values (any shape) where mask is 1, or as heavy as it says. With several processes the sum is ours, the count
    that of all, times their number: so the mean over processes is the mean over the whole batch."""
    count = mask.sum()
    if distributed.is_initialized():
        count = count.detach().clone()
        distributed.all_reduce(count)
        count = count / distributed.get_world_size()
    return (values * mask).sum() / count.clamp(min=1e-6)


def action_error(predicted: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """-log N(a; mu, sigma^2 I) up to scale and constant: mean over ticks and dimensions. (M, L, n), mask (M, L)."""
    return mean_over(((predicted - target) ** 2).mean(-1), mask)


def kl_each(mean: Tensor, log_std: Tensor, free: float = 0.0) -> Tensor:
    """KL(N(mean, std^2) || N(0, I)) of each skill [nat], summed over z (Kingma & Welling 2014, appendix B). free: nats
    that each dimension may say at the same price (free bits: Kingma et al. 2016, C.8; there of the batch's mean, here
    of each skill, so that several processes need not agree on it)."""
    return (0.5 * (mean**2 + torch.exp(2 * log_std) - 1) - log_std).clamp(min=free).sum(-1)


def kl_to_standard_normal(mean: Tensor, log_std: Tensor, free: float = 0.0) -> Tensor:
    kl = kl_each(mean, log_std, free)
    return mean_over(kl, torch.ones_like(kl))


def kl_between(mean: Tensor, log_std: Tensor, prior_mean: Tensor, prior_log_std: Tensor) -> Tensor:
    """KL(N(mean, std^2) || N(prior_mean, prior_std^2)) of diagonal Gaussians, (..., n) -> (...) [nat]."""
    ratio = torch.exp(2 * (log_std - prior_log_std))
    apart = ((mean - prior_mean) / torch.exp(prior_log_std)) ** 2
    return (0.5 * (ratio + apart - 1) - (log_std - prior_log_std)).sum(-1)


def termination_error(logit: Tensor, begins: Tensor, mask: Tensor) -> Tensor:
    """-log Bernoulli(b) of eta, (B, N): mean over ticks."""
    return mean_over(torch.nn.functional.binary_cross_entropy_with_logits(logit, begins, reduction="none"), mask)


def share_carried(change: Tensor, carried: Tensor, slots: int) -> tuple[Tensor, Tensor]:
    """How much of the tip's motion each object's own repeats, <change, carried> / |carried|^2 within 0 .. 1, and
    |carried|^2: where that is small it tells nothing. (..., change_dim) -> (..., slots)."""
    change, carried = (x[..., : 6 * slots].unflatten(-1, (slots, 6)) for x in (change, carried))
    square = (carried**2).sum(-1)
    return ((change * carried).sum(-1) / square.clamp(min=1e-6)).clamp(0, 1), square


def held_error(logit: Tensor, change: Tensor, carried: Tensor, mask: Tensor) -> Tensor:
    """-log Bernoulli of an object's being held, (M, L, S)."""
    target, square = share_carried(change, carried, logit.shape[-1])
    weight = mask[..., None] * (square > 0.05)
    return mean_over(torch.nn.functional.binary_cross_entropy_with_logits(logit, target, reduction="none"), weight)


def pushed(s: State, rad: float, rest_ticks: int, rng) -> tuple[Tensor, Tensor]:
    """Beside the demonstration: pushes (B, joints) [rad] of standard deviation `rad` of half of the Lite 6's first
    states, and where its gripper stands the other way (B,), -1 for some of these, else 1. None where an object stirs
    within rest_ticks: what is held would be held otherwise."""
    n = min(rest_ticks + 1, s.p.shape[1])
    stirs = ((s.p[:, :n] - s.p[:, :1]).norm(dim=-1) * s.known[:, :1]).amax((1, 2)) > 5e-3
    chance, push = rng.random(len(s.p)), rng.normal(size=(len(s.p), s.agent.shape[-1] - 1))
    push = rad * push * (chance < 0.5)[:, None]
    flip = np.where(chance < FLIPPED, -1.0, 1.0)
    push, flip = (torch.from_numpy(x.astype("f4")).to(s.p) for x in (push, flip))
    return push * ~stirs[:, None], torch.where(stirs, 1.0, flip)


def near_error(got: State, want: State, arm: kinematics.Arm, mask: Tensor) -> Tensor:
    """How far a rollout of the Lite 6 stays from the demonstration where it counts: known objects seen from the
    tip, |dp| + TURN_LENGTH * angle in units of 2 cm, weighed by 1 / (1 + (distance from the tip / REACH)^2).
    (B, N, ...)."""
    p, R = (list(x) for x in zip(*(_seen_from_tip(s, arm) for s in (got, want)), strict=True))
    apart = torch.sqrt(((p[0] - p[1]) ** 2).sum(-1) + 1e-8)
    apart = apart + TURN_LENGTH * kinematics.angle_between(R[0], R[1])
    weight = want.known / (1 + (p[1] ** 2).sum(-1) / REACH**2)
    return mean_over((apart / UNIT * weight).sum(-1), mask)


def _seen_from_tip(s: State, arm: kinematics.Arm) -> tuple[Tensor, Tensor]:
    p_WG, R_WG = arm.tip(s.agent[..., :-1])
    R_GW = R_WG.transpose(-1, -2)[..., None, :, :]
    return (R_GW @ (s.p - p_WG[..., None, :])[..., None])[..., 0], R_GW @ s.R


class RolloutError(torch.nn.Module):
    """How far a rollout stays from the demonstration, as `intabs evaluate` measures it (evaluate/metrics.py)."""

    def __init__(self, scaling: Scaling):
        super().__init__()
        for name in ("agent", "p", "environment"):
            spread = torch.as_tensor(getattr(scaling, name), dtype=torch.float32)
            self.register_buffer(name, torch.where(spread > 0, 1 / spread.clamp(min=1e-9), 0.0))

    def forward(self, got: State, want: State, mask: Tensor) -> Tensor:
        """States (B, N, ...), mask (B, N) -> (3,): joints, position, orientation; mean over ticks of the L2 norm over
        the dimensions of each group, in ranges of the training split and half turns."""
        seen = want.valid[..., None]
        position = torch.cat(
            [
                ((got.p - want.p) * self.p * seen).flatten(-2),
                (got.environment - want.environment) * self.environment,
            ],
            -1,
        )
        angle = kinematics.angle_between(got.R, want.R) / torch.pi * want.valid
        groups = ((got.agent - want.agent) * self.agent, position, angle)
        norms = [torch.sqrt((e**2).sum(-1) + 1e-8) if e.shape[-1] else mask * 0 for e in groups]
        return torch.stack([mean_over(n, mask) for n in norms])
