"""Where skills begin in joint training, as `objective.cuts` says:

- motion: where the bodies' motion changes (train/boundaries.py), found once.
- viterbi: where the model itself tells the recording at the least cost; found again every RECUT steps.
- exact: every segmentation of a window counts as much as it explains, by the sum over all (semi-Markov: Sarawagi &
  Cohen 2004), beside windows cut as for viterbi.
- gumbel: a network draws them, and learns through them by a straight-through estimator (Jang et al. 2017; Kim et al.
  2019).
- reinforce: it draws, and learns from what everything from there on costs (Williams 1992): the method's own way
  (Shankar & Gupta 2020).

Costs are nats: -log p(a | s, z) with a fixed standard deviation, and -log of the prior of a skill's beginning.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, distributed, nn

from intabs.errors import UserError
from intabs.model.networks import InteractionAbstractions, encoder_inputs, phase, phase_basis
from intabs.model.space import State
from intabs.train.boundaries import Boundaries
from intabs.train.objective import mean_over
from intabs.train.windows import Windows

KINDS = ("motion", "viterbi", "exact", "gumbel", "reinforce")
DRAWN = ("gumbel", "reinforce")
RECUT = 500  # steps
SIGMA = 0.3  # of what pi predicts, in units of its scale
RATE = 1 / 16  # prior: a skill begins so often
STRETCH = 160  # ticks of a recording cut at a time
WINDOWS = 4  # of a batch whose segmentations are all counted
GRID = 2  # ticks: there they have their cuts
TEMPERATURE = 0.5  # of the straight-through estimator
CLIP = 10.0  # nats
HIDDEN = 48


class Cutter(nn.Module):
    """For each tick of a window the logit that a skill begins there, (B, N), from agent, objects and what they do."""

    def __init__(self, model: InteractionAbstractions):
        super().__init__()
        self.input = nn.Linear(model.agent_dim + model.environment_dim, HIDDEN)
        self.lstm = nn.LSTM(HIDDEN, HIDDEN, batch_first=True, bidirectional=True)
        self.begins = nn.Linear(2 * HIDDEN, 1)
        nn.init.constant_(self.begins.bias, math.log(RATE / (1 - RATE)))

    def forward(self, x: Tensor) -> Tensor:
        return self.begins(self.lstm(torch.tanh(self.input(x)))[0])[..., 0]

    def look(self, model: InteractionAbstractions, batch: Windows) -> Tensor:
        return self(torch.cat(Told(model, batch).inputs, -1))


def load_cutter(model: InteractionAbstractions, state: dict | None) -> Cutter | None:
    if state is None:
        return None
    cutter = Cutter(model)
    cutter.load_state_dict(state)
    return cutter


def draw(logit: Tensor, mask: Tensor, segment: tuple[int, int], chance: Tensor) -> Tensor:
    """Skills of segment[0] .. segment[1] ticks, the last of a window maybe shorter: (B, N) 1 where one begins. chance:
    (B, N) uniform numbers."""
    low, high = segment
    p = torch.sigmoid(logit.detach())
    begins, age = torch.zeros_like(p), torch.zeros(len(p), device=p.device)
    begins[:, 0] = 1
    for t in range(1, p.shape[1]):
        age = age + 1
        now = ((age >= low) & (chance[:, t] < p[:, t]) | (age >= high)) & (mask[:, t] > 0)
        begins[:, t] = now.float()
        age = torch.where(now, 0, age)
    return begins


def choices(begins: Tensor, mask: Tensor, segment: tuple[int, int]) -> Tensor:
    """(B, N) 1 where `draw` had the choice."""
    t = torch.arange(begins.shape[1], device=begins.device)
    last = torch.cummax(torch.where(begins > 0, t, -1), 1).values
    age = t[None, 1:] - last[:, :-1]
    return torch.nn.functional.pad(((age >= segment[0]) & (age < segment[1])) * mask[:, 1:], (1, 0))


# --- what a skill costs -----------------------------------------------------------------------------------------------
class Told:
    """A batch as the model tells it: what the encoders see, what pi sees and should answer."""

    def __init__(self, model: InteractionAbstractions, batch: Windows):
        self.model, self.batch, space = model, batch, model.space
        now, after = batch.state[:, :-1], batch.state[:, 1:]
        self.state, tip = space.features(now)
        response, self.change = space.between(now, after)
        self.command = batch.command if batch.command is not None else response
        self.carried = space.carried(now, tip, after.agent[..., : space.joints])
        self.inputs = encoder_inputs(space, self.state, batch.command, response, self.change)

    def encode(self) -> tuple[Tensor, Tensor]:
        return self.model.encode(*(self.batch.pieces(x) for x in self.inputs), self.batch.within)

    def errors(self, z: Tensor) -> Tensor:
        """-log p(a | s, z) of each tick of each skill [nat], (M, L), up to a constant. z (M, 16) or (M, L, 16)."""
        b, space = self.batch, self.model.space
        seen = b.pieces(self.state)
        z = z if z.dim() == 3 else z[:, None].expand(-1, seen.shape[1], -1)
        age = torch.arange(seen.shape[1], device=seen.device, dtype=seen.dtype)[None]
        basis = phase_basis(phase(age, b.within.sum(1, keepdim=True)))
        y = self.model.pi(self.model.policy_input(seen, z, basis))
        change = self.model.change(y, b.pieces(self.carried) if space.arm is not None else None)
        command = ((y["agent"] - b.pieces(self.command)) ** 2).sum(-1)
        return (command + ((change - b.pieces(self.change)) ** 2).sum(-1)) / (2 * SIGMA**2) * b.within


def costs(model: InteractionAbstractions, batch: Windows) -> Tensor:
    """Of each skill of the batch [nat], (M,)."""
    told = Told(model, batch)
    length = batch.within.sum(1)
    return told.errors(told.encode()[0]).sum(1) - math.log(RATE) - (length - 1) * math.log(1 - RATE)


def prior_error(logit: Tensor, free: Tensor) -> Tensor:
    """KL of the network's Bernoulli distributions to that of RATE [nat], mean over ticks where it had the choice."""
    p = torch.sigmoid(logit)
    kl = p * (nn.functional.logsigmoid(logit) - math.log(RATE))
    kl = kl + (1 - p) * (nn.functional.logsigmoid(-logit) - math.log(1 - RATE))
    return mean_over(kl, free)


def straight_through(logit: Tensor, begins: Tensor, free: Tensor, chance: Tensor) -> Tensor:
    """begins (B, N) again, with the gradient of sigmoid((logit + noise) / TEMPERATURE): the noise is drawn (chance:
    uniform numbers) among those that lead to these begins."""
    p = torch.sigmoid(logit.detach())
    u = torch.where(begins > 0, chance * p, p + chance * (1 - p)).clamp(1e-4, 1 - 1e-4)
    soft = torch.sigmoid((logit - torch.logit(u)) / TEMPERATURE) * free
    return begins + soft - soft.detach()


def gumbel_error(told: Told, z: Tensor, logit: Tensor, chance: Tensor, segment: tuple[int, int]) -> Tensor:
    """-log p(a | s, z) with z(t) = b(t) z_new + (1 - b(t)) z(t - 1), differentiable in b; mean over ticks [nat]."""
    b = told.batch
    begins, free = begins_of(b), choices(begins_of(b), b.mask, segment)
    b_t = straight_through(logit, begins, free, chance)[..., None]
    after = torch.arange(len(z), device=z.device) + (b.whole > 0).long()  # the next skill, if the window has it
    new = torch.where(begins[..., None] > 0, z[b.skill], z[after[b.skill]])
    at = [z[b.skill[:, 0]]]
    for t in range(1, begins.shape[1]):
        at.append(b_t[:, t] * new[:, t] + (1 - b_t[:, t]) * at[-1])
    return mean_over(told.errors(b.pieces(torch.stack(at, 1))), b.within)


def reinforce_error(told: Told, z: Tensor, logit: Tensor, segment: tuple[int, int]) -> Tensor:
    """-log p(b) weighed by how much less everything from there on costs [nat] than it does on average over the batch
    (Williams 1992; return to go, with a baseline); by no more than CLIP nats."""
    b = told.batch
    begins = begins_of(b)
    free = choices(begins, b.mask, segment)
    with torch.no_grad():
        errors = told.errors(z)
        cost = torch.zeros(begins.numel(), device=z.device)
        cost = cost.index_put((b.gather[b.within > 0],), errors[b.within > 0]).view_as(begins)
        to_go = cost.flip(1).cumsum(1).flip(1)
        sums = torch.stack([(to_go * b.mask).sum(0), b.mask.sum(0)])
        if distributed.is_initialized():
            distributed.all_reduce(sums)
        mean = sums[0] / sums[1].clamp(min=1)
        better = ((mean - to_go) * free).clamp(-CLIP, CLIP)
    log_p = -nn.functional.binary_cross_entropy_with_logits(logit, begins, reduction="none")
    return -mean_over(better * log_p, free)


def begins_of(batch: Windows) -> Tensor:
    """(B, N) 1 where a skill begins."""
    return ((batch.age == 0) * batch.mask).float()


def all_skills(batch: Windows, segment: tuple[int, int], grid: int = 1) -> tuple[Windows, Tensor]:
    """Every stretch of the windows that may be a skill, as pieces, and (M, 3) where each stands: window, first tick,
    length. The last of a window may be shorter. grid: cuts are at its multiples."""
    low, high = segment
    count, steps = batch.mask.sum(1).long().tolist(), batch.mask.shape[1]
    rows = [
        (b, a, n)
        for b, last in enumerate(count)
        for a in range(0, last, grid)
        for n in range(1, min(high, last - a) + 1)
        if (n >= low and (a + n) % grid == 0) or a + n == last
    ]
    place = torch.tensor(rows, device=batch.mask.device)
    offset = torch.arange(int(place[:, 2].max()), device=place.device)[None]
    gather = place[:, :1] * steps + place[:, 1:2] + torch.minimum(offset, place[:, 2:] - 1)
    return batch.stretches(gather, (offset < place[:, 2:]).float()), place


def exact_error(model: InteractionAbstractions, batch: Windows, segment: tuple[int, int]) -> Tensor:
    """-log of the sum over all segmentations of the first WINDOWS windows of exp(-cost), a tick [nat]."""
    rows = batch.ours.rows if batch.ours else slice(None)  # of several processes each has its share of them
    mine = min(len(range(WINDOWS)[rows]), len(batch.mask))
    a_tick = batch.mask.new_zeros(0)
    if mine:
        few = batch.first(mine)
        skills, place = all_skills(few, segment, GRID)
        steps, last = few.mask.shape[1], few.mask.sum(1).long()
        total = log_sum(table(costs(model, skills), place, mine, steps, segment[1]))
        a_tick = total.gather(1, last[:, None] - 1)[:, 0] / last
    return mean_over(a_tick, torch.ones_like(a_tick))


def table(cost: Tensor, place: Tensor, windows: int, steps: int, longest: int) -> Tensor:
    """Costs as (windows, longest, steps): [b, n - 1, e] of the skill of n ticks whose last one is e; else infinity."""
    out = cost.new_full((windows, longest, steps), float("inf"))
    return out.index_put((place[:, 0], place[:, 2] - 1, place[:, 1] + place[:, 2] - 1), cost)


def log_sum(cost: Tensor) -> Tensor:
    """-log of the sum over all segmentations of exp(-their cost), of stretches from 0 to each tick:
    table (B, longest, N) -> (B, N)."""
    longest, steps = cost.shape[1:]
    ends = [cost.new_zeros(len(cost))]  # of the log of the sum, before tick 0, 1, ...
    for e in range(steps):
        n = torch.arange(1, min(longest, e + 1) + 1)
        before = torch.stack([ends[e + 1 - int(k)] for k in n], 1)
        ends.append(torch.logsumexp((before - cost[:, n - 1, e]).clamp(min=-1e6), 1))
    return -torch.stack(ends[1:], 1)


def best_cuts(cost: np.ndarray, last: int) -> list[int]:
    """Viterbi on one window's table (longest, N): ticks at which skills begin, and `last`."""
    best, back = np.full(last + 1, np.inf), np.zeros(last + 1, int)
    best[0] = 0
    for e in range(1, last + 1):
        n = np.arange(1, min(len(cost), e) + 1)
        total = best[e - n] + cost[n - 1, e - 1]
        k = int(np.argmin(total))
        best[e], back[e] = total[k], e - n[k]
    cuts = [last]
    while cuts[-1] > 0:
        cuts.append(int(back[cuts[-1]]))
    return cuts[::-1]


@torch.no_grad()
def own_cuts(model, state: State, command: Tensor | None, segment: tuple[int, int]) -> np.ndarray:
    """Where the model itself tells a recording at the least cost: ticks at which skills begin, and last T - 1. In
    stretches of STRETCH ticks, each from the last cut but one of the one before."""
    cuts, end = [0], len(state.agent) - 1
    while cuts[-1] < end:
        a = cuts[-1]
        b = min(a + STRETCH, end)
        batch, place = all_skills(Windows.one(state[a : b + 1], command[a:b] if command is not None else None), segment)
        cost = costs(model, batch)
        found = best_cuts(table(cost, place, 1, b - a, segment[1])[0].cpu().numpy(), b - a)
        cuts += [a + c for c in (found[1:] if b == end else found[1:-2] or found[1:2])]
    return np.array(cuts)


def likeliest(logit: Tensor, segment: tuple[int, int]) -> np.ndarray:
    """The most likely cuts of one recording by the network's logits (N,): ticks at which skills begin, and N."""
    low, high = segment
    gain = logit.double().numpy()
    cost = np.full((high, len(gain)), np.inf)
    for e in range(len(gain)):  # a skill that ends with tick e: what it costs is its beginning
        for n in range(1, min(high, e + 1) + 1):
            if n >= low or e == len(gain) - 1:
                cost[n - 1, e] = -gain[e + 1 - n] if e + 1 > n else 0.0
    return np.array(best_cuts(cost, len(gain)))


class Cuts:
    """Of whole recordings, by one of KINDS."""

    def __init__(self, model: InteractionAbstractions, recorded: list[State], objective: dict, cutter: Cutter | None):
        self.kind = objective.get("cuts", "motion")  # runs of before there was a choice
        self.model, self.cutter, self.segment = model, cutter, tuple(objective["segment"])
        if self.kind not in KINDS:
            raise UserError(f"objective.cuts is {self.kind!r}: write one of {', '.join(KINDS)}")
        if self.kind in DRAWN and cutter is None:
            raise UserError(f"cuts by {self.kind} need the network that draws them: give the run, not exported weights")
        self.boundaries = Boundaries(model.space, recorded, objective["boundaries"]) if self.kind == "motion" else None

    @torch.no_grad()
    def of(self, state: State, command: Tensor | None) -> np.ndarray:
        """Ticks at which skills begin, and last T - 1. state (T, ...), command (T - 1, A) in units of its scale: on the
        CPU."""
        if self.boundaries:
            return self.boundaries.cuts(state)
        device = self.model.space.mean.device
        state, command = state.map(lambda x: x.to(device)), command.to(device) if command is not None else None
        if self.cutter is None:
            return own_cuts(self.model, state, command, self.segment)
        return likeliest(self.cutter.look(self.model, Windows.one(state, command))[0].cpu(), self.segment)
