"""Demonstrations at another rate. Continuous signals are low-passed before they are thinned out (Butterworth, forwards
and backwards: no delay), rotations as rotations, switches by the last value, actions by the path they add up to.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation, Slerp

from intabs.data.demos import Demo
from intabs.errors import UserError

# Of the new rate's Nyquist frequency: -6 dB there, -17 dB at Nyquist, -44 dB at one and a half of it.
CUTOFF = 0.8
ORDER = 4


def heal_signs(q: np.ndarray) -> tuple[np.ndarray, int]:
    """(T, 4) with q and -q told apart so that neighbours are close; how often that changed."""
    flip = np.einsum("ij,ij->i", q[1:], q[:-1]) < 0
    sign = np.concatenate([[1.0], np.where(np.cumsum(flip) % 2, -1.0, 1.0)])[: len(q)]
    return q * sign[:, None], int(flip.sum())


def wxyz(q_xyzw: np.ndarray) -> np.ndarray:
    return np.roll(q_xyzw, 1, axis=-1)


def xyzw(q_wxyz: np.ndarray) -> np.ndarray:
    return np.roll(q_wxyz, -1, axis=-1)


class Resampler:
    """From the times of one demonstration to a steady rate that begins where it begins."""

    def __init__(self, time: np.ndarray, rate_hz: float):
        step = np.diff(time)
        if len(time) < 4 or not np.isfinite(time).all() or (step <= 0).any():
            raise UserError("cannot be resampled: needs four frames or more whose time advances")
        self.source = time
        # One gap does not make a grid of a million frames.
        self.period = max(float(np.median(step)), (time[-1] - time[0]) / (4 * len(time)))
        self.steady = np.append(np.arange(time[0], time[-1], self.period), time[-1])
        count = int(np.floor((time[-1] - time[0]) * rate_hz + 1e-6)) + 1
        if count < 2:
            raise UserError(f"lasts {time[-1] - time[0]:.3g} s: too short for {rate_hz:g} Hz")
        self.time = time[0] + np.arange(count) / rate_hz
        relative = CUTOFF * rate_hz * self.period
        self.sos = butter(ORDER, relative, output="sos") if relative < 0.98 else None
        self.settling = int(5 / relative) + 1  # frames

    def continuous(self, x: np.ndarray) -> np.ndarray:
        """(T, n) -> (T', n)."""
        x = np.asarray(x, float)
        if self.sos is not None:
            even = np.stack([np.interp(self.steady, self.source, c) for c in x.T], axis=1)
            x, at = self._low_pass(even), self.steady
        else:
            at = self.source
        return CubicSpline(at, x)(self.time) if len(x) > 3 else x[self.last(at)]

    def _low_pass(self, x: np.ndarray) -> np.ndarray:
        return sosfiltfilt(self.sos, x, axis=0, padtype="odd", padlen=min(self.settling, len(x) - 1))

    def rotation(self, q: np.ndarray) -> np.ndarray:
        """(T, 4) wxyz -> (T', 4). Where it is filtered: the mean rotation in the chordal sense."""
        q, _ = heal_signs(q / np.linalg.norm(q, axis=1, keepdims=True))
        at = self.source
        if self.sos is not None:
            even = self._slerp(at, q, self.steady)
            q = self._low_pass(heal_signs(even)[0])
            q /= np.linalg.norm(q, axis=1, keepdims=True)
            at = self.steady
        return heal_signs(self._slerp(at, q, self.time))[0]

    @staticmethod
    def _slerp(at: np.ndarray, q: np.ndarray, time: np.ndarray) -> np.ndarray:
        return wxyz(Slerp(at, Rotation.from_quat(xyzw(q)))(np.clip(time, at[0], at[-1])).as_quat())

    def last(self, at: np.ndarray | None = None) -> np.ndarray:
        """Index of the last source frame at or before each new one."""
        at = self.source if at is None else at
        return np.clip(np.searchsorted(at, self.time + 1e-9, side="right") - 1, 0, len(at) - 1)

    def pose(self, pose: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(T, 7), (T,) -> (T', 7), (T',). A new frame is valid where the source is on both sides."""
        if valid.sum() < 2:
            i = self.last()
            return pose[i], valid[i]
        seen = np.flatnonzero(valid)
        time = np.clip(self.source, self.source[seen[0]], self.source[seen[-1]])
        q = pose[seen, 3:] / np.maximum(np.linalg.norm(pose[seen, 3:], axis=1, keepdims=True), 1e-12)
        filled = np.empty_like(pose, float)
        for c in range(3):
            filled[:, c] = np.interp(time, self.source[seen], pose[seen, c])
        filled[:, 3:] = self._slerp(self.source[seen], q, time)
        before = self.last()
        after = np.clip(np.searchsorted(self.source, self.time - 1e-9), 0, len(self.source) - 1)
        out = np.concatenate([self.continuous(filled[:, :3]), self.rotation(filled[:, 3:])], axis=1)
        return out, valid[before] & valid[after]


def steps_of(joint_pos: np.ndarray, gripper: np.ndarray | None) -> np.ndarray:
    """Actions of a recording without any: the step to the next frame [rad a tick], gripper +-1 if there is one."""
    step = np.diff(joint_pos, axis=0, append=joint_pos[-1:])
    return step if gripper is None else np.column_stack([step, np.where(gripper > 0.5, 1.0, -1.0)])


def resample(demo: Demo, rate_hz: float) -> Demo:
    """`demo` at `rate_hz`. Fields of unknown meaning beside the observations (states, source_actions) are left out."""
    r = Resampler(demo.time, rate_hz)
    last = r.last()
    poses = [r.pose(demo.object_pose[:, i], demo.object_valid[:, i].astype(bool))
             for i in range(demo.object_pose.shape[1])]  # fmt: skip
    obs = {}
    for name, value in demo.obs.items():
        if name.endswith("_quat") and value.shape[1:] == (4,):
            obs[name] = r.rotation(value)
        elif value.dtype.kind == "f" and not name.endswith("_valid"):
            obs[name] = r.continuous(value.reshape(len(value), -1)).reshape(-1, *value.shape[1:])
        else:
            obs[name] = value[last]
    # Actions are steps: the path they add up to is what is resampled. The gripper's is a switch.
    actions = demo.actions
    joints = None if demo.joint_pos is None else demo.joint_pos.shape[1]
    n = joints if demo.gripper is not None and joints is not None else actions.shape[1]
    path = np.concatenate([np.zeros((1, n)), np.cumsum(actions[:, :n], axis=0)])[:-1]
    path = r.continuous(path)
    step = np.diff(path, axis=0, append=path[-1:])
    rate = 1.0 / float(np.median(np.diff(demo.time)))
    return Demo(
        time=r.time,
        joint_pos=None if demo.joint_pos is None else r.continuous(demo.joint_pos),
        joint_vel=None if demo.joint_vel is None else r.continuous(demo.joint_vel),
        gripper=None if demo.gripper is None else demo.gripper[last],
        object_pose=np.stack([p for p, _ in poses], axis=1) if poses else np.zeros((len(r.time), 0, 7)),
        object_valid=np.stack([v for _, v in poses], axis=1) if poses else np.zeros((len(r.time), 0), bool),
        actions=np.column_stack([step, actions[last, n:]]),
        attrs=demo.attrs | {"rate_hz": float(rate_hz), "source_rate_hz": round(rate, 3)},
        obs=obs,
        extra={k: v[last] for k, v in demo.extra.items() if k in ("labels", "filled")},
    )  # fmt: skip
