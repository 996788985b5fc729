"""What happens between gripper and objects, frame by frame, for evaluation only: derived from the plant's contacts,
beads and motion, never from the demonstrator's script.

`data/demo_k/labels` (T,) uint8 indexes KINDS, which the file's attribute `label_names` repeats.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, median_filter
from scipy.spatial.transform import Rotation

KINDS = (
    "wait",  # nothing moves, nothing is held
    "reach",  # free, under way to an object
    "approach",  # free, the last centimetres
    "grasp",  # fingers close on it
    "hold",  # held or leant on, and nothing moves
    "lift",
    "carry",
    "lower",
    "release",  # fingers open
    "retreat",  # free, away from an object
    "pull",  # a drawer, outwards
    "push",  # a drawer, inwards
    "open lid",
    "close lid",
    "tilt",
    "pour",  # tilted, and beads leave
    "return upright",
    "insert",  # a spoon, into a vessel
    "stir",
    "withdraw",  # a spoon, out of it
)
_INDEX = {name: i for i, name in enumerate(KINDS)}

# Object ids of OBJECT_POSES, and where a gripper takes them, in their frame [m].
BLOCK, GOAL, DRAWER, LID, CUP, BOWL, SPOON = range(7)
HANDLE = {BLOCK: (0, 0, 0.034), DRAWER: (0, 0, 0), LID: (-0.094, 0, 0), CUP: (-0.051, 0, 0.048), SPOON: (0, 0, 0)}
SPOON_TIP = (0, 0, -0.086)
RIM, INNER = 0.052, 0.046  # of the bowl [m]

LEFT_FINGER, RIGHT_FINGER, SCENE = 1 << 4, 1 << 5, 1 << 7  # core/types.h kTouches...
TICK_S = 0.04
SMOOTH_TICKS = 1.5  # of speeds
MOVING, SLIDING = 0.012, 0.008  # m/s: of tip or object; of a drawer
TURNING = 0.08  # rad/s
NEAR = 0.045  # m, tip from handle
SHORTEST = 4  # ticks; shorter runs go to their neighbour
GRIP_TICKS = 10  # the fingers close or open within


@dataclass
class Truth:
    """What the plant knew, tick by tick."""

    ids: np.ndarray  # (S,)
    pose: np.ndarray  # (T, S, 7) xyz wxyz
    touches: np.ndarray  # (T, S) uint8
    beads_in: np.ndarray  # (T, S)


def label(tip: np.ndarray, gripper_closed: np.ndarray, truth: Truth) -> np.ndarray:
    """tip (T, 3) of the gripper in W [m]; gripper_closed (T,) commanded. Returns (T,) uint8."""
    return _Labeller(tip, np.asarray(gripper_closed) > 0.5, truth).labels()


def segments(labels: np.ndarray) -> list[tuple[str, int, int]]:
    """(kind, first frame, frame after the last)."""
    edges = np.flatnonzero(np.diff(labels)) + 1
    return [(KINDS[labels[a]], int(a), int(b)) for a, b in _pairs([0, *edges, len(labels)])]


def _pairs(edges: list) -> list[tuple[int, int]]:
    return list(zip(edges[:-1], edges[1:], strict=True))


def _rate(x: np.ndarray) -> np.ndarray:
    """Of change, smoothed, along time [1/s]."""
    return np.gradient(gaussian_filter1d(np.asarray(x, float), SMOOTH_TICKS, axis=0), TICK_S, axis=0)


class _Labeller:
    def __init__(self, tip: np.ndarray, closed: np.ndarray, truth: Truth):
        self.tip, self.closed, self.truth = tip, closed, truth
        self.slot = {int(i): s for s, i in enumerate(truth.ids) if i >= 0}
        self.rotation = {i: Rotation.from_quat(np.roll(truth.pose[:, s, 3:], -1, axis=1)) for i, s in self.slot.items()}
        self.tip_speed = np.linalg.norm(_rate(tip), axis=1)
        fingers = truth.touches & (LEFT_FINGER | RIGHT_FINGER)
        # A flicker of one tick is no change of hands.
        self.one = {i: median_filter((fingers[:, s] > 0).astype(np.uint8), 3) > 0 for i, s in self.slot.items()}
        both = LEFT_FINGER | RIGHT_FINGER
        self.both = {i: median_filter((fingers[:, s] == both).astype(np.uint8), 3) > 0 for i, s in self.slot.items()}

    def labels(self) -> np.ndarray:
        out = self._free()
        for i in HANDLE:
            if i not in self.slot:
                continue
            kind = {DRAWER: self._drawer, LID: self._lid}.get(i, self._object)(i)
            at = self.one[i] & self.closed if i == LID else self.both[i] & self.closed
            out = np.where(at, kind, out)
        out = self._fingers(out)
        return _without_short(out).astype(np.uint8)

    # --- nothing in the fingers
    def _free(self) -> np.ndarray:
        present = [i for i in HANDLE if i in self.slot]
        handles = [self.truth.pose[:, self.slot[i], :3] + self.rotation[i].apply(HANDLE[i]) for i in present]
        distance = np.array([np.linalg.norm(self.tip - h, axis=1) for h in handles])  # (n, T)
        nearest = distance.argmin(0)
        toward = -np.take_along_axis(_rate(distance.T).T, nearest[None], 0)[0]
        d = distance.min(0)
        touched = np.any([self.one[i] for i in present], axis=0)
        last = np.flatnonzero(touched)[-1] if touched.any() else -1
        away = np.zeros(len(d), bool)
        # After a touch it retreats, until it has come away and comes nearer to something again.
        leaving = False
        for t in range(len(d)):
            if touched[t]:
                leaving = True
            elif leaving and t < last and toward[t] > MOVING and d[t] > NEAR:
                leaving = False
            away[t] = leaving
        kind = np.where(away | ((d < NEAR) & (toward < 0)), _INDEX["retreat"], _INDEX["reach"])
        kind = np.where((d < NEAR) & (toward > MOVING / 2), _INDEX["approach"], kind)
        return np.where(self.tip_speed < MOVING, _INDEX["wait"], kind)

    def _fingers(self, out: np.ndarray) -> np.ndarray:
        """Closing on something, and opening again."""
        change = np.diff(self.closed.astype(int), prepend=int(self.closed[0]))
        held = np.zeros(len(self.closed), bool)
        for i in self.both.keys() & HANDLE.keys() - {LID}:
            held |= self.both[i] & self.closed
        still = self.tip_speed < MOVING
        for t in np.flatnonzero(change):
            span = slice(t, t + GRIP_TICKS)
            if change[t] > 0 and held[span].any():
                out[span] = np.where(still[span], _INDEX["grasp"], out[span])
            elif change[t] < 0 and t and held[t - 1]:
                out[span] = np.where(still[span], _INDEX["release"], out[span])
        return out

    # --- something in the fingers
    def _drawer(self, i: int) -> np.ndarray:
        pose = self.truth.pose[:, self.slot[i]]
        outwards = -np.einsum("tk,tk->t", _rate(pose[:, :3]), self.rotation[i].apply([1, 0, 0]))
        kind = np.where(outwards > SLIDING, _INDEX["pull"], _INDEX["hold"])
        return np.where(outwards < -SLIDING, _INDEX["push"], kind)

    def _lid(self, i: int) -> np.ndarray:
        lid = self.rotation[i].apply([-1, 0, 0])  # from the hinge to the tab
        opening = _rate(np.arcsin(np.clip(lid[:, 2], -1, 1)))  # up to upright; beyond, the other way round
        opening *= np.where(self.rotation[i].apply([0, 0, 1])[:, 2] < 0, -1, 1)
        kind = np.where(opening > TURNING, _INDEX["open lid"], _INDEX["hold"])
        return np.where(opening < -TURNING, _INDEX["close lid"], kind)

    def _object(self, i: int) -> np.ndarray:
        s = self.slot[i]
        v = _rate(self.truth.pose[:, s, :3])
        speed, level = np.linalg.norm(v, axis=1), np.linalg.norm(v[:, :2], axis=1)
        kind = np.full(len(v), _INDEX["carry"])
        kind = np.where(v[:, 2] > level, _INDEX["lift"], kind)
        kind = np.where(-v[:, 2] > level, _INDEX["lower"], kind)
        kind = np.where(speed < MOVING, _INDEX["hold"], kind)
        if i == CUP:
            kind = self._cup(i, kind)
        if i == SPOON and BOWL in self.slot:
            kind = self._spoon(i, kind)
        return kind

    def _cup(self, i: int, kind: np.ndarray) -> np.ndarray:
        tilt = np.arccos(np.clip(self.rotation[i].apply([0, 0, 1])[:, 2], -1, 1))
        turning = _rate(tilt)
        leaving = _rate(self.truth.beads_in[:, self.slot[i]]) < -0.5  # beads a second
        kind = np.where(turning > TURNING, _INDEX["tilt"], kind)
        kind = np.where(turning < -TURNING, _INDEX["return upright"], kind)
        return np.where(leaving & (tilt > np.radians(30)) & (turning > -TURNING), _INDEX["pour"], kind)

    def _spoon(self, i: int, kind: np.ndarray) -> np.ndarray:
        bowl = self.truth.pose[:, self.slot[BOWL], :3]
        tip = self.truth.pose[:, self.slot[i], :3] + self.rotation[i].apply(SPOON_TIP) - bowl
        v = _rate(tip)
        level = np.linalg.norm(v[:, :2], axis=1)
        over = np.linalg.norm(tip[:, :2], axis=1) < INNER
        inside = over & (tip[:, 2] < RIM)
        kind = np.where(inside & (level > MOVING), _INDEX["stir"], kind)
        # On its way in and out it counts from a little above the rim.
        near = over & (tip[:, 2] < 2 * RIM)
        kind = np.where(near & (v[:, 2] < -np.maximum(level, MOVING)), _INDEX["insert"], kind)
        return np.where(near & (v[:, 2] > np.maximum(level, MOVING)), _INDEX["withdraw"], kind)


def _without_short(labels: np.ndarray) -> np.ndarray:
    """Runs shorter than SHORTEST go to the longer of their neighbours, the shortest first."""
    labels = labels.copy()
    while True:
        edges = [0, *(np.flatnonzero(np.diff(labels)) + 1), len(labels)]
        runs = _pairs(edges)
        short = [(b - a, k) for k, (a, b) in enumerate(runs) if b - a < SHORTEST]
        if not short or len(runs) < 2:
            return labels
        k = min(short)[1]
        beside = [n for n in (k - 1, k + 1) if 0 <= n < len(runs)]
        n = max(beside, key=lambda j: runs[j][1] - runs[j][0])
        labels[slice(*runs[k])] = labels[runs[n][0]]
