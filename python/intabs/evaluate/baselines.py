"""What the learned skills are held against. Each takes a motion and the ticks at which it is cut, and gives back what
its own description of the pieces, chained from the first state, says."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from intabs.evaluate.metrics import Motion, Sample, Scaling, joined
from intabs.model.kinematics import log_so3


class Method(Protocol):
    name: str

    def reconstruct(self, of: Sample, cuts: list[int]) -> Motion:
        """Cuts: first 0, last len(of.motion) - 1. The answer's first state is the motion's."""


class Still:
    """Stays where it begins."""

    name = "still"

    def reconstruct(self, of: Sample, cuts: list[int]) -> Motion:
        return of.motion[np.zeros(len(of.motion), int)]


# --- displacements: what PCA and the mean describe --------------------------------------------------------------------
class Displacement:
    """A motion as displacement from its start, resampled to N ticks, in normalised units: agent (N A,), environment
    (N (3 S + E + 3 S),): positions and rotation vectors / pi of the objects, and environment scalars."""

    N = 12

    def __init__(self, scaling: Scaling):
        self.scaling = scaling

    def _unit(self, spread: np.ndarray) -> np.ndarray:
        return np.where(spread > 0, spread, 1.0)

    def split(self, m: Motion) -> tuple[np.ndarray, np.ndarray]:
        s = self.scaling
        steps = len(m)
        agent = (m.agent - m.agent[0]) / self._unit(s.agent) * (s.agent > 0)
        p = ((m.p - m.p[:1]) / self._unit(s.p) * (s.p > 0)).reshape(steps, -1)
        e = (m.environment - m.environment[0]) / self._unit(s.environment) * (s.environment > 0)
        w = log_so3(m.R @ np.swapaxes(m.R[:1], -1, -2)).reshape(steps, -1) / np.pi if m.R.shape[1] else p
        return self._resampled(agent), self._resampled(np.concatenate([p, e, w], 1))

    def _resampled(self, x: np.ndarray) -> np.ndarray:
        at = np.linspace(0, len(x) - 1, self.N + 1)[1:]
        return np.stack([np.interp(at, np.arange(len(x)), column) for column in x.T], 1).ravel() if x.shape[1] else x[0]

    def joined(self, start: Motion, agent: np.ndarray, environment: np.ndarray, steps: int) -> Motion:
        """The inverse, `steps` ticks with the start as the first."""
        s = self.scaling
        a = self._stretched(agent, start.agent.shape[1], steps) * s.agent
        slots, scalars = start.p.shape[1], start.environment.shape[1]
        e = self._stretched(environment, 6 * slots + scalars, steps)
        p = e[:, : 3 * slots].reshape(steps, slots, 3) * s.p
        w = e[:, 3 * slots + scalars :].reshape(-1, 3) * np.pi
        turn = Rotation.from_rotvec(w).as_matrix().reshape(steps, slots, 3, 3) if slots else start.R[[0] * steps]
        return Motion(
            start.agent[:1] + a,
            start.p[:1] + p,
            turn @ start.R[:1],
            start.environment[:1] + e[:, 3 * slots : 3 * slots + scalars] * s.environment,
            np.repeat(start.valid[:1], steps, 0),
        )

    def _stretched(self, flat: np.ndarray, width: int, steps: int) -> np.ndarray:
        x = np.concatenate([np.zeros((1, width)), flat.reshape(self.N, width)])
        at = np.linspace(0, self.N, steps)
        return np.stack([np.interp(at, np.arange(self.N + 1), c) for c in x.T], 1) if width else np.zeros((steps, 0))


def chained(motion: Motion, cuts: list[int], piece) -> Motion:
    """piece(start, segment, steps) -> Motion of `steps` ticks from `start`; each begins where the last one ended."""
    out = [motion[:1]]
    for a, b in zip(cuts, cuts[1:], strict=False):
        out.append(piece(out[-1][-1:], motion[a : b + 1], b - a + 1)[1:])
    return joined(out)


def training_pieces(motions: list[Motion], segment: int, stride: int = 2) -> list[Motion]:
    return [
        m[a : a + n]
        for m in motions
        for n in (segment - 2, segment, segment + 2)
        for a in range(0, len(m) - n + 1, stride)
    ]


def share_out(agent: np.ndarray, environment: np.ndarray, positions: int, size: int = 16) -> tuple[int, int]:
    """How many of `size` principal components are best of the agent's and how many of the environment's displacement:
    those with which joints, positions and orientations are left with least, each as long as it is on average.
    agent (M, ticks, n); environment (M, ticks, m), `positions` numbers first, then orientations; normalised."""
    if not environment.size:
        return size, 0
    parts = [np.linalg.svd(_flat(x) - _flat(x).mean(0), full_matrices=False) for x in (agent, environment)]

    def left(of: int, like: np.ndarray, components: int) -> np.ndarray:
        U, s, V = parts[of]
        return ((U[:, components:] * s[components:]) @ V[components:]).reshape(like.shape)

    def cost(k: int) -> float:
        objects = left(1, environment, size - k)
        groups = left(0, agent, k), objects[..., :positions], objects[..., positions:]
        return sum(float(np.linalg.norm(g, axis=-1).mean()) for g in groups)

    k = min(range(1, size), key=cost)
    return k, size - k


def _flat(x: np.ndarray) -> np.ndarray:
    return x.reshape(len(x), -1)


class Pca:
    """Principal components of the segments' displacement, agent and environment apart, as many numbers as z; sizes:
    of each, shared out by the training split where nothing is said."""

    name = "pca"

    def __init__(self, train: list[Motion], scaling: Scaling, segment: int, sizes: tuple[int, int] | None = None):
        self.shape = Displacement(scaling)
        agent, environment = (
            np.array(rows) for rows in zip(*map(self.shape.split, training_pieces(train, segment)), strict=True)
        )
        ticks = self.shape.N
        positions = 3 * train[0].p.shape[1] + train[0].environment.shape[1]
        self.sizes = sizes or share_out(*(x.reshape(len(x), ticks, -1) for x in (agent, environment)), positions)
        self.parts = []
        for x, k in zip((agent, environment), self.sizes, strict=True):
            mean = x.mean(0)
            _, _, components = np.linalg.svd(x - mean, full_matrices=False) if x.shape[1] else (0, 0, x[:0])
            self.parts.append((mean, components[:k]))

    def encode(self, segment: Motion) -> np.ndarray:
        """(16,) or fewer numbers."""
        return np.concatenate([U @ (x - m) for x, (m, U) in zip(self.shape.split(segment), self.parts, strict=True)])

    def reconstruct(self, of: Sample, cuts: list[int]) -> Motion:
        def piece(start: Motion, segment: Motion, steps: int) -> Motion:
            back = [m + (U @ (x - m)) @ U for x, (m, U) in zip(self.shape.split(segment), self.parts, strict=True)]
            return self.shape.joined(start, *back, steps)

        return chained(of.motion, cuts, piece)


class Mean:
    """The mean displacement of the training split: of whole demonstrations, or of segments."""

    name = "mean"

    def __init__(self, train: list[Motion], scaling: Scaling, segment: int):
        self.shape = Displacement(scaling)
        self.segment = self._mean(training_pieces(train, segment))
        self.shape.N = 60
        self.whole = self._mean(train)

    def _mean(self, motions: list[Motion]) -> tuple[int, np.ndarray, np.ndarray]:
        rows = [self.shape.split(m) for m in motions]
        return self.shape.N, np.mean([r[0] for r in rows], 0), np.mean([r[1] for r in rows], 0)

    def reconstruct(self, of: Sample, cuts: list[int]) -> Motion:
        self.shape.N, agent, environment = self.segment if len(cuts) == 2 else self.whole
        return self.shape.joined(of.motion[:1], agent, environment, len(of.motion))
