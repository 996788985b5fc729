"""Segment pretraining: one z a segment of 12 to 16 ticks, cut at random from the demonstrations."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch

from intabs.data.features import Normalizer, Readings, Trajectory
from intabs.errors import UserError


@dataclass
class Segments:
    """A batch: n segments of T ticks each. Normalised."""

    state: torch.Tensor  # (n, T, 59) as recorded: what the encoders see
    seen: torch.Tensor  # (n, T, 59) as a servo and cameras with errors would give it: what pi sees
    agent_action: torch.Tensor  # (n, T, 7)
    environment_action: torch.Tensor  # (n, T, 24)


class SegmentSampler:
    """Batches of segments of equal length. Every start of every demonstration is equally likely.

    trajectories: normalised. noise, standard deviations: {"object_mm", "object_deg"} one error an object and segment,
    {"tick_mm", "joint_mrad"} one a tick.
    """

    def __init__(
        self,
        trajectories: list[Trajectory],
        normalizer: Normalizer,
        arm,
        length: tuple[int, int],
        noise: dict,
        device: str,
    ):
        for i, t in enumerate(trajectories):
            if len(t.state) < length[1]:
                raise UserError(f"demonstration {i} is shorter than a segment of {length[1]} ticks")
        self.normalizer, self.arm, self.length, self.noise, self.device = normalizer, arm, length, noise, device
        self.readings = Readings(
            *(np.concatenate([getattr(t.readings, f.name) for t in trajectories]) for f in fields(Readings))
        )
        self.state = np.concatenate([t.state for t in trajectories])
        self.agent = np.concatenate([t.agent_action for t in trajectories]).astype("f4")
        self.environment = np.concatenate([t.environment_action for t in trajectories])
        self.count = np.array([len(t.state) for t in trajectories])
        self.first = np.cumsum(self.count) - self.count

    def sample(self, n: int, rng: np.random.Generator, noisy: bool = True) -> Segments:
        """`rng` is the whole source of chance; T is drawn anew each call."""
        t = int(rng.integers(self.length[0], self.length[1] + 1))
        starts = self.count - t + 1
        pick = rng.integers(starts.sum(), size=n)
        demo = np.searchsorted(np.cumsum(starts), pick, side="right")
        start = pick - (np.cumsum(starts) - starts)[demo]
        index = (self.first[demo] + start)[:, None] + np.arange(t)[None]
        state = self.state[index]
        seen = self._disturbed(index, rng) if noisy else state

        def tensor(x):
            return torch.from_numpy(np.ascontiguousarray(x)).to(self.device)

        return Segments(tensor(state), tensor(seen), tensor(self.agent[index]), tensor(self.environment[index]))

    def _disturbed(self, index: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        n, t = index.shape
        r = self.readings.map(lambda x: x[index])
        slots = r.object_pose.shape[2]
        q = r.joint_pos + 1e-3 * self.noise["joint_mrad"] * rng.normal(size=r.joint_pos.shape)
        pose = r.object_pose.copy()
        pose[..., :3] += 1e-3 * self.noise["object_mm"] * rng.normal(size=(n, 1, slots, 3))
        pose[..., :3] += 1e-3 * self.noise["tick_mm"] * rng.normal(size=(n, t, slots, 3))
        turn = np.radians(self.noise["object_deg"]) * rng.normal(size=(n, 1, slots, 3))
        pose[..., 3:] = _turned(pose[..., 3:], turn)
        disturbed = Readings(q, r.gripper_closed, pose, r.object_known, r.object_valid)
        flat = disturbed.map(lambda x: x.reshape(n * t, *x.shape[2:]))
        return self.normalizer.normalize_state(flat.state(self.arm)).reshape(n, t, -1)


def _turned(q: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) wxyz turned by small rotation vectors (..., 3): first order, normalised."""
    a, v = q[..., :1], q[..., 1:]
    h = 0.5 * w
    out = np.concatenate([a - (h * v).sum(-1, keepdims=True), v + a * h + np.cross(h, v)], axis=-1)
    norm = np.linalg.norm(out, axis=-1, keepdims=True)
    return np.where(norm > 0, out / np.maximum(norm, 1e-12), q)
