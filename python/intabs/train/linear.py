"""Where training starts: the linear paths of encoders and pi already do what linear maps can.

A skill's steps r_t are described by coefficients C of the phase basis, r_t = sum_k b_k(t) C_k; a skill's course is what
they add up to. z are the numbers that tell most of it beside the state it begins in: a regression of reduced rank
(Izenman 1975) from what the encoders pool, of the very motion or, where there are replays, of another one of the same
recording; z^r and z^e by turns, each for what the other leaves. pi's linear path is the regression of its outputs on
all it sees. On the Lite 6 it is fitted on states pushed aside, too, from which commands lead back: so it goes to where
the objects are, not to where they were.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from intabs.model.networks import BASIS, LATENT, InteractionAbstractions, encoder_inputs, phase, phase_basis
from intabs.replay.replay import RETURN
from intabs.train.objective import RolloutError
from intabs.train.windows import Windows, WindowSampler

BATCHES, SIZE = 24, 64
POINTS = 12  # of the displacement's course that is compared
NOT_HELD = -3.0  # logit
QUIET = 0.1  # of the initial weights that the LSTMs' outputs keep
TURNS = 8  # of z^r and z^e
PUSH, STIRS = 0.03, 1e-3  # rad: pushes of half of the states; joints that move by less in a tick are not pushed


@torch.no_grad()
def start_linear(
    model: InteractionAbstractions, sampler: WindowSampler, error: RolloutError, groups: list[float], seed: int
) -> None:
    """error: for the weights of the dimensions; groups: of joints, object position, object orientation."""
    space = model.space
    rng = np.random.default_rng(seed)
    batches = [sampler.sample(SIZE, rng) for _ in range(BATCHES)]
    rows = _Rows(model, batches)
    agent, objects = _courses(space, rows, error, groups)
    course = torch.cat([agent, objects], 1)
    names, size = list(model.encoders), 2 * LATENT // len(model.encoders)
    if space.arm is not None:  # beside the state, which pi's linear path sees
        wanted = dict.fromkeys(names, course - _fitted(rows.start, course))
    else:  # each its own part: with few motions what one tells of the other's is chance
        of_agent, of_objects = (x - x.mean(0) for x in (agent, objects))
        no_agent, no_objects = torch.zeros_like(agent), torch.zeros_like(objects)
        parts = {"q_agent": (of_agent, no_objects), "q_environment": (no_agent, of_objects)}
        wanted = {name: torch.cat(parts.get(name, (of_agent, of_objects)), 1) for name in names}
    together = space.arm is not None and len(names) > 1  # by turns, each the rest that the other leaves
    z: dict[str, Tensor] = {}
    told = {name: torch.zeros_like(course) for name in names}
    for _ in range(TURNS if together else 1):
        for name in names:
            rest = wanted[name] - (sum(told[other] for other in names if other != name) if together else 0)
            _, _, directions = torch.linalg.svd(_fitted(rows.pooled[name], rest), full_matrices=False)
            z[name] = rest @ directions[:size].T
            told[name] = _fitted(rows.pooled[name], z[name]) @ directions[:size]
    latents = []
    for name, q in model.encoders.items():
        # As a linear function of what the encoder pools, of unit deviation.
        x = rows.pooled[name]
        W, b = _ridge(x, z[name] / _fitted(x, z[name]).std(0).clamp(min=1e-6))
        _set_skip(q, "mean", W, b, first=q.spec["input"] - W.shape[0])
        q.heads["log_std"].weight *= QUIET
        latents.append(x @ W + b)
    codes = torch.cat(latents, -1)

    if "carried" in model.pi.heads:
        _set_skip(model.pi, "carried", torch.zeros(1, space.slots), torch.full((space.slots,), NOT_HELD), first=0)
    # Columns: [s, b_k, z, z b_0, z b_1, ...]. Objects are moved by z alone: of what lies far off none is to stir.
    s = space.state_dim
    for name, c in rows.coefficients.items():
        if space.arm is not None and name != "environment":
            continue
        W, b = _ridge(codes, c.flatten(1), 1e-3)
        dims = c.shape[-1]
        columns = torch.zeros(model.pi.spec["input"], dims)
        columns[s : s + BASIS] = b.view(BASIS, dims)
        per_basis = W.view(2 * LATENT, BASIS, dims).transpose(0, 1).reshape(BASIS * 2 * LATENT, dims)
        columns[s + BASIS + 2 * LATENT :] = per_basis
        _set_skip(model.pi, name, columns, torch.zeros(dims), first=0)
    if space.arm is not None:
        _follow_state(model, batches, codes, rows.keep, rng)


class _Rows:
    """Of the skills of some batches that are not cut short, one row each."""

    def __init__(self, model: InteractionAbstractions, batches: list[Windows]):
        space = model.space
        self.pooled: dict[str, Tensor] = {}  # what an encoder's linear path sees
        self.coefficients: dict[str, Tensor] = {}  # of pi's outputs, (n, BASIS, dims)
        pooled: dict[str, list] = {name: [] for name in model.encoders}
        outputs: dict[str, list] = {name: [] for name in model.pi.heads if name != "carried"}
        gram, ticks, start = torch.zeros(BASIS, BASIS), [], []
        self.keep: list[Tensor] = []  # of each batch, (M,)
        for w in batches:
            features, _ = space.features(w.state[:, :-1])
            response, change = space.between(w.state[:, :-1], w.state[:, 1:])
            command = w.command if w.command is not None else response
            seen = space.features(w.shown[:, :-1])[0]
            views = encoder_inputs(space, seen, w.shown_command, *space.between(w.shown[:, :-1], w.shown[:, 1:]))
            views = {"q_agent": views[0], "q_environment": views[1], "q_joint": torch.cat(views, -1)}
            n = w.within.sum(1)
            keep = n >= 6  # a window's last skill may be cut short
            basis = phase_basis(phase(torch.arange(w.gather.shape[1])[None], n[:, None])) * w.within[..., None]
            mean = basis[keep] / n[keep, None, None]
            gram += torch.einsum("mlj,mlk->jk", basis[keep], mean) / keep.sum() / len(batches)
            for name, parts in pooled.items():
                parts.append(torch.einsum("mlk,mld->mkd", mean, w.pieces(views[name])[keep]).flatten(1))
            for name, parts in outputs.items():
                value = {"agent": command, "response": response, "environment": change}[name]
                parts.append(torch.einsum("mlk,mld->mkd", mean, w.pieces(value)[keep]))
            start.append(w.pieces(features)[keep, 0])
            ticks.append(n[keep])
            self.keep.append(keep)
        inverse = torch.linalg.inv(gram + 1e-4 * torch.eye(BASIS))
        self.pooled = {k: torch.cat(v) for k, v in pooled.items()}
        self.coefficients = {k: torch.einsum("jk,mkd->mjd", inverse, torch.cat(v)) for k, v in outputs.items()}
        self.start, self.ticks = torch.cat(start), torch.cat(ticks)


def _courses(space, rows: _Rows, error: RolloutError, groups: list[float]) -> tuple[Tensor, Tensor]:
    """What the coefficients do to a rollout, (n, POINTS dims) of agent and of objects, weighed as the error does."""
    at = torch.linspace(0, 1, POINTS + 1)[1:]
    fine = torch.linspace(0, 1, 240)
    integral = torch.stack([(phase_basis(fine) * (fine <= t)[:, None]).mean(0) for t in at])  # (POINTS, BASIS)
    length = rows.ticks[:, None, None]
    moves = rows.coefficients["response" if space.arm is not None else "agent"]
    joints = length * torch.einsum("pk,mkd->mpd", integral, moves)
    courses = [joints * space.response_scale * error.agent[: space.joints] * groups[0]]
    if space.arm is not None:
        gripper = torch.einsum("pk,mkd->mpd", phase_basis(at), rows.coefficients["agent"][..., -1:])
        courses.append(gripper * error.agent[-1] * groups[0])
    weight = torch.cat([error.p, torch.full_like(error.p, 1 / torch.pi)], 1)  # positions, rotation vectors
    weight = weight * torch.tensor([groups[1]] * 3 + [groups[2]] * 3)
    weight = torch.cat([weight.flatten(), error.environment * groups[1]])
    objects = length * torch.einsum("pk,mkd->mpd", integral, rows.coefficients["environment"])
    return torch.cat(courses, -1).flatten(1), (objects * space.change_scale * weight).flatten(1)


def _follow_state(
    model: InteractionAbstractions, batches: list[Windows], z: Tensor, keep: list[Tensor], rng: np.random.Generator
) -> None:
    """pi's linear path to commands and responses of the Lite 6, from all it sees, half of it beside the recording."""
    space, at, x, y = model.space, 0, [], []
    for w, kept in zip(batches, keep, strict=True):
        now, n = w.state[:, :-1], w.within.sum(1)
        push = torch.from_numpy(rng.normal(size=(*now.agent.shape[:2], space.joints)).astype("f4"))
        push = PUSH * push * (space.response_scale > STIRS)
        push = push * torch.from_numpy((rng.random(now.agent.shape[:2]) < 0.5).astype("f4"))[..., None]
        aside = now.map(lambda v: v)
        aside.agent = torch.cat([now.agent[..., :-1] + push, now.agent[..., -1:]], -1)
        seen = space.features(aside)[0]
        back = RETURN * push
        response = space.between(now, w.state[:, 1:])[0] - back / space.response_scale
        command = w.command - torch.nn.functional.pad(back / space.command_scale[:-1], (0, 1))
        basis = phase_basis(phase(torch.arange(w.gather.shape[1])[None].float(), n[:, None]))[kept]
        of = z[at : at + int(kept.sum())]
        at += len(of)
        # The gripper stays as it is nearly always: commands would be read off its state, and it would never close.
        seen[..., space.joints] = 0
        inputs = model.policy_input(w.pieces(seen)[kept], of[:, None].expand(-1, basis.shape[1], -1), basis)
        inside = w.within[kept] > 0
        x.append(inputs[inside])
        y.append(torch.cat([w.pieces(command)[kept], w.pieces(response)[kept]], -1)[inside])
    W, b = _ridge(torch.cat(x), torch.cat(y), 1e-4)
    for name, part in (("agent", slice(0, space.agent)), ("response", slice(space.agent, None))):
        _set_skip(model.pi, name, W[:, part], b[part], first=0)


def _fitted(x: Tensor, y: Tensor) -> Tensor:
    """What a ridge regression on x says of y."""
    W, b = _ridge(x, y)
    return x @ W + b


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
