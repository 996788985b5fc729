"""Where skills begin and end: a semi-Markov model of interaction.

A skill is a stretch in which the same bodies move in the same way. Each tick is described by how much the agent and
each object move (`activity`); a skill explains its ticks by their mean, at a fixed price a skill. The best cuts are
Viterbi's (Sarawagi & Cohen, Semi-Markov conditional random fields, 2004): exact, and O(T L) as sums over a stretch are
differences of cumulative sums.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from intabs.model.kinematics import log_so3
from intabs.model.space import Space, State

SMOOTH = 1.0  # ticks, of velocities; objects, whose poses come from images:
SMOOTH_OBJECTS = 1.5


@dataclass
class BoundaryConfig:
    penalty: float  # price of a skill, in units of squared activity
    shortest: int  # ticks
    longest: int
    still: float  # share of the usual speed of a body that moves, below which it counts as still


@dataclass
class Speeds:
    """Usual ones, of the training split; a tick."""

    agent: float  # m of the tip, or root mean square of normalised joint steps
    agent_turn: float  # rad
    objects: float  # m
    objects_turn: float  # rad

    @staticmethod
    def fit(space: Space, states: list[State]) -> Speeds:
        bodies = [_velocities(space, s) for s in states]

        def usual(parts: list[np.ndarray]) -> float:
            speed = np.concatenate([np.linalg.norm(x, axis=-1).ravel() for x in parts])
            moving = speed[speed > 0.1 * max(np.sqrt((speed**2).mean()), 1e-9)]
            return float(np.sqrt((moving**2).mean())) if len(moving) else 1.0

        return Speeds(*(usual([x for b in bodies for x in b[k]] or [np.zeros((1, 3))]) for k in range(4)))


def _velocities(space: Space, s: State) -> tuple[list[np.ndarray], ...]:
    """Agent's, its turning, objects', their turning: lists of (T, 3) (the agent without an arm: (T, A))."""

    def turning(R: np.ndarray, smooth: float) -> np.ndarray:
        w = log_so3(R[1:] @ np.swapaxes(R[:-1], -1, -2))
        return gaussian_filter1d(np.concatenate([w, w[-1:]]), smooth, axis=0)

    if space.arm is not None:
        p, R = (x.cpu().numpy().astype("f8") for x in space.arm.tip(s.agent[:, : space.joints]))
        agent, turn = [gaussian_filter1d(p, SMOOTH, axis=0, order=1)], [turning(R, SMOOTH)]
    else:
        a = (s.agent / space.response_scale).numpy().astype("f8") / np.sqrt(space.joints)
        agent, turn = [gaussian_filter1d(a, SMOOTH, axis=0, order=1)], []
    p, R, seen = (x.cpu().numpy().astype("f8") for x in (s.p, s.R, s.known))
    slots = [i for i in range(space.slots) if seen[:, i].any()]
    objects = [gaussian_filter1d(p[:, i], SMOOTH_OBJECTS, axis=0, order=1) * seen[:, i, None] for i in slots]
    turns = [turning(R[:, i], SMOOTH_OBJECTS) * seen[:, i, None] for i in slots]
    if space.environment:
        e = (s.environment / space.change_scale[6 * space.slots :]).numpy().astype("f8")
        turns.append(gaussian_filter1d(e, SMOOTH, axis=0, order=1) / np.sqrt(space.environment))
    return agent, turn, objects, turns


def activity(space: Space, s: State, speeds: Speeds, still: float) -> np.ndarray:
    """(T, n): for each body how much it moves and how much of it upwards, how much it turns, each between 0 (still) and
    1; half of the gripper's +-1."""
    agent, turn, objects, turns = _velocities(space, s)
    columns = []

    def saturated(v: np.ndarray, usual: float, upwards: bool) -> None:
        scale = still * usual + np.linalg.norm(v, axis=1)
        columns.append(np.linalg.norm(v, axis=1) / scale)
        if upwards:
            columns.append(v[:, 2] / scale)

    for v in agent:
        saturated(v, speeds.agent, space.arm is not None)
    for v in turn:
        saturated(v, speeds.agent_turn, False)
    for v in objects:
        saturated(v, speeds.objects, True)
    for v in turns:
        saturated(v, speeds.objects_turn, False)
    if space.arm is not None:
        columns.append(0.5 * s.agent[:, -1].numpy())
    return np.stack(columns, 1)


class SemiMarkov:
    """Segmentations of one demonstration, x (T, n) its activity."""

    def __init__(self, x: np.ndarray, config: BoundaryConfig):
        self.T, self.c = len(x), config
        self.sum = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, 0)])
        self.square = np.concatenate([[0.0], np.cumsum((x**2).sum(1))])
        self.longest = min(config.longest, self.T)
        self.shortest = min(config.shortest, self.T)

    def cost(self, begins: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Of skills of the ticks begins .. ends - 1: squared distance from their mean, and the price."""
        s = self.sum[ends] - self.sum[begins]
        return self.square[ends] - self.square[begins] - (s**2).sum(-1) / (ends - begins) + self.c.penalty

    def _before(self, end: int) -> np.ndarray:
        return end - np.arange(self.shortest, min(self.longest, end) + 1)

    def viterbi(self) -> np.ndarray:
        """Ticks at which skills begin, the first is 0."""
        best, back = np.full(self.T + 1, np.inf), np.zeros(self.T + 1, int)
        best[0] = 0
        for end in range(self.shortest, self.T + 1):
            begins = self._before(end)
            total = best[begins] + self.cost(begins, np.full(len(begins), end))
            k = int(np.argmin(total))
            best[end], back[end] = total[k], begins[k]
        cuts, at = [], self.T
        while at > 0:
            at = int(back[at])
            cuts.append(at)
        return np.array(cuts[::-1])


class Boundaries:
    """The model of one training split."""

    def __init__(self, space: Space, states: list[State], config: dict):
        self.space, self.config = space, BoundaryConfig(**config)
        self.speeds = Speeds.fit(space, states)

    def cuts(self, state: State) -> np.ndarray:
        """Ticks at which skills begin, and last T - 1 (the last tick with an action is T - 2)."""
        x = activity(self.space, state, self.speeds, self.config.still)[:-1]
        return np.append(SemiMarkov(x, self.config).viterbi(), len(x))
