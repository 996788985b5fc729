"""Where training starts: the linear paths of encoders and pi hold the principal components of the skills' motion.

A skill's steps r_t are described by coefficients C of the phase basis, r_t = sum_k b_k(t) C_k, a linear function of
the encoder's mean input; z are the principal components of C; pi's linear path gives r_t back from z b_k(t). So the
first rollout is as good as principal components, and what the LSTMs learn comes on top (figures: python/README.md).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from intabs.model.networks import BASIS, LATENT, InteractionAbstractions, encoder_inputs, phase, phase_basis
from intabs.train.objective import RolloutError
from intabs.train.windows import WindowSampler

BATCHES, SIZE = 24, 64
POINTS = 12  # of the displacement's course that is compared
NOT_HELD = -3.0  # logit
QUIET = 0.1  # of the initial weights that the LSTMs' outputs keep


@torch.no_grad()
def start_linear(
    model: InteractionAbstractions, sampler: WindowSampler, error: RolloutError, groups: list[float], seed: int
) -> None:
    """error: for the weights of the dimensions; groups: of joints, object position, object orientation."""
    space = model.space
    rng = np.random.default_rng(seed)
    pooled: dict[str, list[Tensor]] = {name: [] for name in model.encoders}
    outputs: dict[str, list[Tensor]] = {name: [] for name in model.pi.heads if name != "carried"}
    gram, ticks = torch.zeros(BASIS, BASIS), []
    for _ in range(BATCHES):
        w = sampler.sample(SIZE, rng)
        now, after = w.state[:, :-1], w.state[:, 1:]
        features, _ = space.features(now)
        response, change = space.between(now, after)
        command = w.command if w.command is not None else response
        agent, environment = encoder_inputs(space, features, w.command, response, change)
        n = w.within.sum(1)
        keep = n >= 6  # a window's last skill may be cut short
        basis = phase_basis(phase(torch.arange(w.gather.shape[1])[None], n[:, None])) * w.within[..., None]
        mean = basis[keep] / n[keep, None, None]
        gram += torch.einsum("mlj,mlk->jk", basis[keep], mean) / keep.sum() / BATCHES
        views = {"q_agent": agent, "q_environment": environment, "q_joint": torch.cat([agent, environment], -1)}
        for name, rows in pooled.items():
            rows.append(torch.einsum("mlk,mld->mkd", mean, w.pieces(views[name])[keep]))
        for name, rows in outputs.items():
            value = {"agent": command, "response": response, "environment": change}[name]
            rows.append(torch.einsum("mlk,mld->mkd", mean, w.pieces(value)[keep]))
        ticks.append(n[keep])
    inverse = torch.linalg.inv(gram + 1e-4 * torch.eye(BASIS))
    length = torch.cat(ticks)
    coefficients = {k: torch.einsum("jk,mkd->mjd", inverse, torch.cat(v)) for k, v in outputs.items()}

    # What a coefficient does to the rollout: the agent's course, then the objects'.
    at = torch.linspace(0, 1, POINTS + 1)[1:]
    fine = torch.linspace(0, 1, 240)
    course = torch.stack([(phase_basis(fine) * (fine <= t)[:, None]).mean(0) for t in at])  # integrals, (POINTS, BASIS)
    value = phase_basis(at)
    moves = "response" if space.arm is not None else "agent"
    joints = length[:, None, None] * torch.einsum("pk,mkd->mpd", course, coefficients[moves])
    agent_course = [joints * space.response_scale * error.agent[: space.joints] * groups[0]]
    if space.arm is not None:
        gripper = torch.einsum("pk,mkd->mpd", value, coefficients["agent"][..., -1:])
        agent_course.append(gripper * error.agent[-1] * groups[0])
    weight = torch.cat([error.p, torch.full_like(error.p, 1 / torch.pi)], 1)  # positions, rotation vectors
    weight = weight * torch.tensor([groups[1]] * 3 + [groups[2]] * 3)
    weight = torch.cat([weight.flatten(), error.environment * groups[1]])
    objects = length[:, None, None] * torch.einsum("pk,mkd->mpd", course, coefficients["environment"])
    courses = {
        "q_agent": torch.cat(agent_course, -1).flatten(1),
        "q_environment": (objects * space.change_scale * weight).flatten(1),
    }
    courses["q_joint"] = torch.cat(list(courses.values()), 1)

    latents = []
    for name, q in model.encoders.items():
        size = 2 * LATENT if len(model.encoders) == 1 else LATENT
        x = courses[name] - courses[name].mean(0)
        _, _, components = torch.linalg.svd(x, full_matrices=False)
        wanted = x @ components[:size].T
        scale = wanted.std(0).clamp(min=1e-6)
        # z as a linear function of what the encoder pools: ridge regression, on z of unit deviation.
        inputs = torch.cat(pooled[name]).flatten(1)
        W, b = _ridge(inputs, wanted / scale)
        _set_skip(q, "mean", W, b, first=q.spec["input"] - W.shape[0])
        q.heads["log_std"].weight *= QUIET
        latents.append(inputs @ W + b)
    if "carried" in model.pi.heads:
        _set_skip(model.pi, "carried", torch.zeros(1, space.slots), torch.full((space.slots,), NOT_HELD), first=0)
    z = torch.cat(latents, -1)
    for name, c in coefficients.items():
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
