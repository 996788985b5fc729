"""Reconstruction error, one definition for every method: how far the rollout of a demonstration's skills, started at
its first state, stays from the demonstration."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from intabs.data.demos import Demo
from intabs.model.kinematics import Arm
from intabs.model.space import State, state_of

GROUPS = ("joints", "position", "orientation")
CONSTANT = 1e-4  # a dimension that varies by less over the training split is dropped;
SEEN_CONSTANT = 2e-3  # m; of an object's position, as perceived poses of what rests vary by so much


@dataclass
class Motion:
    """States of one trajectory, T ticks, in their own units."""

    agent: np.ndarray  # (T, A)
    p: np.ndarray  # (T, S, 3) objects in W [m]
    R: np.ndarray  # (T, S, 3, 3)
    environment: np.ndarray  # (T, E) joints of articulated objects and the like; counted as positions
    valid: np.ndarray  # (T, S) bool

    def __len__(self) -> int:
        return len(self.agent)

    def __getitem__(self, index: slice) -> Motion:
        return Motion(*(getattr(self, f.name)[index] for f in fields(self)))


def motion_of(s: State) -> Motion:
    parts = [x.detach().cpu().numpy().astype("f8") for x in (s.agent, s.p, s.R, s.environment)]
    return Motion(*parts, s.valid.cpu().numpy() > 0)


def seen_from_tip(m: Motion, arm: Arm) -> Motion:
    """The Lite 6's objects in the frame of its tip, p_GO and R_GO, instead of in W."""
    p_WG, R_WG = (x.numpy().astype("f8") for x in arm.tip(torch.from_numpy(m.agent[:, :-1].astype("f4"))))
    R_GW = np.swapaxes(R_WG, -1, -2)[:, None]
    return Motion(m.agent, (R_GW @ (m.p - p_WG[:, None])[..., None])[..., 0], R_GW @ m.R, m.environment, m.valid)


def joined(parts: list[Motion]) -> Motion:
    return Motion(*(np.concatenate([getattr(m, f.name) for m in parts]) for f in fields(Motion)))


@dataclass
class Scaling:
    """Ranges of the training split; 0: constant there, dropped."""

    agent: np.ndarray  # (A,)
    p: np.ndarray  # (S, 3)
    environment: np.ndarray  # (E,)
    objects: np.ndarray  # (S,) bool: seen at all

    @staticmethod
    def fit(motions: list[Motion]) -> Scaling:
        every = joined(motions)

        def spread(x: np.ndarray, constant: float = CONSTANT) -> np.ndarray:
            if not len(x):
                return np.zeros(x.shape[1:])
            r = np.ptp(x, axis=0)
            return np.where(r > constant, r, 0.0)

        slots = every.p.shape[1]
        p = [spread(every.p[every.valid[:, i], i], SEEN_CONSTANT) for i in range(slots)]
        return Scaling(
            spread(every.agent),
            np.stack(p) if slots else np.zeros((0, 3)),
            spread(every.environment),
            every.valid.any(0),
        )


def _scaled(difference: np.ndarray, spread: np.ndarray) -> np.ndarray:
    used = spread > 0
    return difference[..., used] / spread[used]


def differences(got: Motion, want: Motion, scaling: Scaling) -> dict[str, np.ndarray]:
    """Group -> (T, dimensions), normalised; 0 where the demonstration does not know the object's pose."""
    steps = len(want)
    seen = want.valid[..., None]
    p = np.where(seen & (scaling.p > 0), (got.p - want.p) / np.where(scaling.p > 0, scaling.p, 1), 0)
    angle = np.zeros(want.valid.shape)
    if want.valid.any():
        turn = np.swapaxes(got.R, -1, -2) @ want.R
        angle[want.valid] = Rotation.from_matrix(turn[want.valid]).magnitude() / np.pi
    return {
        "joints": _scaled(got.agent - want.agent, scaling.agent),
        "position": np.concatenate(
            [
                p.reshape(steps, -1)[:, scaling.p.ravel() > 0],
                _scaled(got.environment - want.environment, scaling.environment),
            ],
            1,
        ),
        "orientation": angle[:, scaling.objects],
    }


def errors(got: Motion, want: Motion, scaling: Scaling) -> dict[str, float]:
    """`all` and each group: mean over ticks of the L2 norm over its dimensions (the thesis' way); `balanced`: mean of
    the groups' root mean squares. The first tick is given, so it does not count."""
    d = {k: v[1:] for k, v in differences(got, want, scaling).items()}
    out = {"all": float(np.linalg.norm(np.concatenate(list(d.values()), 1), axis=1).mean())}
    present = {k: v for k, v in d.items() if v.shape[1]}
    out["balanced"] = float(np.mean([np.sqrt((v**2).mean()) for v in present.values()]))
    for group in GROUPS:
        out[group] = float(np.linalg.norm(d[group], axis=1).mean()) if group in present else 0.0
    return out


def fixed_cuts(length: int, segment: int) -> list[int]:
    """Ticks where segments of about `segment` ticks begin and end: first 0, last length - 1; neighbours share one."""
    n = max(1, round((length - 1) / (segment - 1)))
    return np.linspace(0, length - 1, n + 1).round().astype(int).tolist()


@dataclass
class Sample:
    """A demonstration or a piece of it, as every method takes it."""

    motion: Motion
    state: State
    command: torch.Tensor | None  # a^r of the Lite 6 [rad a tick], gripper +-1

    def piece(self, a: int, b: int) -> Sample:
        """Ticks a to b, both of them in."""
        command = self.command[a:b] if self.command is not None else None
        return Sample(self.motion[a : b + 1], self.state[a : b + 1], command)


def sample(demo: Demo) -> Sample:
    state, command = state_of(demo)
    return Sample(motion_of(state), state, torch.from_numpy(command) if command is not None else None)
