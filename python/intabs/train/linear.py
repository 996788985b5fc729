"""Where training starts: how many of z's numbers are of the agent and how many of the environment, and the linear paths
of encoders and pi, which hold the principal components of the skills' motion.

A skill's steps r_t are described by coefficients C of the phase basis, r_t = sum_k b_k(t) C_k, a linear function of
the encoder's mean input; z are the principal components of C; pi's linear path gives r_t back from z b_k(t). So the
first rollout is about as good as principal components; what the LSTMs learn comes on top (figures: python/README.md).
Of objects only what they do by themselves counts: what the tip carries goes with the tip (pi's head `carried`), as soon
as that is learned; in the first rollout nothing is held.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from intabs.evaluate.baselines import share_out
from intabs.model.networks import BASIS, LATENT, InteractionAbstractions, encoder_inputs, phase, phase_basis
from intabs.model.space import Space
from intabs.train.objective import RolloutError, share_carried
from intabs.train.windows import WindowSampler

BATCHES, SIZE = 24, 64
POINTS = 12  # of the displacement's course that is compared
NOT_HELD = -3.0  # logit
QUIET = 0.1  # of the initial weights that the LSTMs' outputs keep


@dataclass
class Motion:
    """Of M skills. The displacement's course in the units of RolloutError, POINTS of each; of the Lite 6's objects
    along the tip's axes, though the ranges are those along the axes of W."""

    pooled: dict[str, Tensor]  # of agent and environment, what an encoder's linear path pools: (M, BASIS, n)
    coefficients: dict[str, Tensor]  # of what pi's heads are to say: (M, BASIS, n)
    agent: Tensor  # (M, POINTS, n)
    environment: Tensor  # (M, POINTS, positions + 3 S), positions and scalars first, then rotation vectors / pi
    positions: int

    def sizes(self) -> list[int]:
        """Numbers of z^r and of z^e that the motion asks for."""
        return list(share_out(self.agent.numpy(), self.environment.numpy(), self.positions, 2 * LATENT))


@torch.no_grad()
def measure(space: Space, sampler: WindowSampler, error: RolloutError) -> Motion:
    """Of windows drawn always alike, so that every seed has the same sizes. error: for the units."""
    rng = np.random.default_rng(0)
    pooled: dict[str, list[Tensor]] = {"agent": [], "environment": []}
    outputs: dict[str, list[Tensor]] = {"agent": [], "environment": [], "response": []}
    gram, ticks = torch.zeros(BASIS, BASIS), []
    for _ in range(BATCHES):
        w = sampler.sample(SIZE, rng)
        now, after = w.state[:, :-1], w.state[:, 1:]
        features, tip = space.features(now)
        response, change = space.between(now, after)
        command = w.command if w.command is not None else response
        inputs = encoder_inputs(space, features, w.command, response, change)
        free = change
        if (carried := space.carried(now, tip, after.agent[..., : space.joints])) is not None:
            held = (share_carried(change, carried, space.slots)[0] > 0.5).repeat_interleave(6, -1)
            free = change - carried * torch.nn.functional.pad(held, (0, space.environment))
        n = w.within.sum(1)
        keep = n >= 6  # a window's last skill may be cut short
        basis = phase_basis(phase(torch.arange(w.gather.shape[1])[None], n[:, None])) * w.within[..., None]
        mean = basis[keep] / n[keep, None, None]
        gram += torch.einsum("mlj,mlk->jk", basis[keep], mean) / keep.sum() / BATCHES
        for rows, values in ((pooled, inputs), (outputs, (command, free, response))):
            for kept, value in zip(rows.values(), values, strict=True):
                kept.append(torch.einsum("mlk,mld->mkd", mean, w.pieces(value)[keep]))
        ticks.append(n[keep])
    inverse = torch.linalg.inv(gram + 1e-4 * torch.eye(BASIS))
    length = torch.cat(ticks)[:, None, None]
    coefficients = {k: torch.einsum("jk,mkd->mjd", inverse, torch.cat(v)) for k, v in outputs.items()}

    # What a coefficient does to the rollout.
    at = torch.linspace(0, 1, POINTS + 1)[1:]
    fine = torch.linspace(0, 1, 240)
    course = torch.stack([(phase_basis(fine) * (fine <= t)[:, None]).mean(0) for t in at])  # integrals, (POINTS, BASIS)
    moves = coefficients["response" if space.arm is not None else "agent"]
    agent = length * torch.einsum("pk,mkd->mpd", course, moves) * space.response_scale * error.agent[: space.joints]
    if space.arm is not None:
        gripper = torch.einsum("pk,mkd->mpd", phase_basis(at), coefficients["agent"][..., -1:]) * error.agent[-1]
        agent = torch.cat([agent, gripper], -1)
    objects = length * torch.einsum("pk,mkd->mpd", course, coefficients["environment"]) * space.change_scale
    poses, scalars = objects[..., : 6 * space.slots].unflatten(-1, (space.slots, 6)), objects[..., 6 * space.slots :]
    parts = (poses[..., :3] * error.p).flatten(-2), scalars * error.environment, (poses[..., 3:] / torch.pi).flatten(-2)
    positions = 3 * space.slots + space.environment
    pooled = {k: torch.cat(v) for k, v in pooled.items()}
    return Motion(pooled, coefficients, agent, torch.cat(parts, -1), positions)


@torch.no_grad()
def start_linear(model: InteractionAbstractions, motion: Motion, weights: list[float]) -> None:
    """weights: of joints, object position, object orientation."""
    space = model.space
    pooled = {f"q_{name}": x.flatten(1) for name, x in motion.pooled.items()}
    pooled["q_joint"] = torch.cat(list(motion.pooled.values()), -1).flatten(1)
    joints, *objects = weights
    weighted = motion.environment.clone()
    weighted[..., : motion.positions] *= objects[0]
    weighted[..., motion.positions :] *= objects[1]
    courses = {"q_agent": (joints * motion.agent).flatten(1), "q_environment": weighted.flatten(1)}
    courses["q_joint"] = torch.cat(list(courses.values()), 1)
    latents = []
    for name, q in model.encoders.items():
        x = courses[name] - courses[name].mean(0)
        _, _, components = torch.linalg.svd(x, full_matrices=False)
        wanted = x @ components[: q.spec["heads"]["mean"]].T
        scale = wanted.std(0).clamp(min=1e-6)
        # z as a linear function of what the encoder pools: ridge regression, on z of unit deviation.
        W, b = _ridge(pooled[name], wanted / scale)
        _set_skip(q, "mean", W, b, first=q.spec["input"] - W.shape[0])
        q.heads["log_std"].weight *= QUIET
        latents.append(pooled[name] @ W + b)
    if "carried" in model.pi.heads:
        _set_skip(model.pi, "carried", torch.zeros(1, space.slots), torch.full((space.slots,), NOT_HELD), first=0)
    z = torch.cat(latents, -1)
    for name, c in motion.coefficients.items():
        if name not in model.pi.heads:
            continue
        W, b = _ridge(z, c.flatten(1), 1e-3)
        dims = c.shape[-1]
        # Columns: [s, b_k, z, z b_0, z b_1, ...]; W is (16, BASIS dims).
        columns = torch.zeros(model.pi.spec["input"], dims)
        s = space.state_dim
        columns[s : s + BASIS] = b.view(BASIS, dims)
        per_basis = W.view(2 * LATENT, BASIS, dims).transpose(0, 1).reshape(BASIS * 2 * LATENT, dims)
        columns[s + BASIS + 2 * LATENT :] = per_basis
        _set_skip(model.pi, name, columns, torch.zeros(dims), first=0)


def _ridge(x: Tensor, y: Tensor, strength: float = 1e-2) -> tuple[Tensor, Tensor]:
    """W, b of y = x W + b."""
    mx, my = x.mean(0), y.mean(0)
    x, y = (x - mx).double(), (y - my).double()
    W = torch.linalg.solve(x.T @ x + strength * len(x) * torch.eye(x.shape[1]) * (x**2).mean(), x.T @ y).float()
    return W, my - mx @ W


def _set_skip(net, head: str, columns: Tensor, bias: Tensor, first: int) -> None:
    """Of the linear path beside the LSTMs: weights of the inputs from `first` on, (n, outputs)."""
    layer = net.heads[head]
    inputs = net.spec["input"]
    layer.weight *= QUIET
    layer.weight[:, -inputs:] = 0
    start = layer.weight.shape[1] - inputs + first
    layer.weight[:, start : start + len(columns)] = columns.T
    layer.bias.copy_(bias)
