"""Segment pretraining: one z a segment of 12 to 16 ticks, cut at random from the demonstrations."""

from __future__ import annotations

import numpy as np
import torch

from intabs.errors import UserError
from intabs.data.features import Normalizer, Trajectory
from intabs.model.networks import AGENT_DIM, OBJECT_DIM, OBJECTS


class SegmentSampler:
    """Batches of segments of equal length; `generator` is the whole source of chance."""

    def __init__(self, trajectories: list[Trajectory], length: tuple[int, int], device: str):
        too_short = [i for i, t in enumerate(trajectories) if len(t.state) < length[1]]
        if too_short:
            raise UserError(f"demonstration {too_short[0]} is shorter than a segment of {length[1]} ticks")
        self.length = length
        self.device = device
        self.state = torch.from_numpy(np.concatenate([t.state for t in trajectories])).to(device)
        self.agent = torch.from_numpy(np.concatenate([t.agent_action for t in trajectories])).float().to(device)
        self.environment = torch.from_numpy(np.concatenate([t.environment_action for t in trajectories])).to(device)
        self.first, self.count = [], []
        start = 0
        for t in trajectories:
            self.first.append(start)
            self.count.append(len(t.state))
            start += len(t.state)
        self.first = torch.tensor(self.first)
        self.count = torch.tensor(self.count)

    def sample(self, n: int, generator: torch.Generator) -> tuple[torch.Tensor, ...]:
        """state (n, T, 47), a^r (n, T, 7), a^e (n, T, 24); T drawn anew each call."""
        t = int(torch.randint(self.length[0], self.length[1] + 1, (), generator=generator))
        # Every start of every demonstration equally likely.
        weights = (self.count - t + 1).double()
        demo = torch.multinomial(weights, n, replacement=True, generator=generator)
        start = (torch.rand(n, generator=generator) * weights[demo]).long()
        index = (self.first[demo] + start)[:, None] + torch.arange(t)[None]
        index = index.to(self.device)
        return self.state[index], self.agent[index], self.environment[index]


def perturb(state: torch.Tensor, normalizer: Normalizer, noise: dict, generator: torch.Generator) -> torch.Tensor:
    """What perception and servo do to the state: white noise a tick, one pose error an object and segment."""
    n, t, _ = state.shape

    def normal(*shape):
        return torch.randn(*shape, generator=generator).to(state.device)

    out = state + noise["state"] * normal(n, t, state.shape[2])
    scale = torch.as_tensor(normalizer.state_scale, device=state.device)
    for i in range(OBJECTS):
        a = AGENT_DIM + i * OBJECT_DIM
        known = (state[:, :1, a + 3 : a + 9].abs().sum(-1, keepdim=True) > 0).float()
        out[..., a : a + 3] += known * 1e-3 * noise["object_mm"] * normal(n, 1, 3) / scale[a : a + 3]
        out[..., a + 3 : a + 9] += known * np.radians(noise["object_deg"]) * normal(n, 1, 6) / scale[a + 3 : a + 9]
    return out
