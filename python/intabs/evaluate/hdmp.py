"""Hierarchical dynamic movement primitives: cut where the motion's acceleration peaks, a primitive a piece. An oracle:
it is fitted to the very motion it rebuilds and knows every piece's goal; it holds more numbers than it explains.

`hdmp-faithful`: as the method's comparison seems to have run it (Euler steps, quaternions as plain numbers); `hdmp`:
well built, by the package movement-primitives (Ijspeert et al. 2013; Ude et al. 2014 for orientations).
"""

from __future__ import annotations

import numpy as np
from scipy.signal import find_peaks
from scipy.spatial.transform import Rotation

from intabs.errors import UserError
from intabs.evaluate import packages
from intabs.evaluate.metrics import Motion, Sample

KERNELS = 15
DISTANCE = 15  # ticks, between peaks
TICK = 1 / 64  # s, by the package's clock, which integrates by its millisecond; sums of it are exact


def peaks(x: np.ndarray) -> list[int]:
    """Ticks where the motion (T, n) is cut: peaks of the norm of its second difference, and both ends."""
    second = np.linalg.norm(np.diff(x, 2, axis=0), axis=1)
    inner = find_peaks(second, distance=DISTANCE)[0] + 1
    inner = [int(i) for i in inner if DISTANCE // 2 < i < len(x) - 1 - DISTANCE // 2]
    return [0, *inner, len(x) - 1]


def _columns(m: Motion) -> tuple[np.ndarray, np.ndarray]:
    """(T, n) agent, positions, scalars; (T, S, 4) quaternions wxyz of one sign."""
    steps = len(m)
    q = Rotation.from_matrix(m.R.reshape(-1, 3, 3)).as_quat().reshape(steps, -1, 4) if m.R.shape[1] else m.p[..., :0]
    q = np.roll(q, 1, -1).copy()
    for t in range(1, steps):
        q[t] *= np.where((q[t] * q[t - 1]).sum(-1, keepdims=True) < 0, -1, 1)
    return np.concatenate([m.agent, m.p.reshape(steps, -1), m.environment], 1), q


def _motion(m: Motion, x: np.ndarray, q: np.ndarray) -> Motion:
    a, n = m.agent.shape[1], 3 * m.p.shape[1]
    R = m.R.copy()
    if q.shape[1]:
        unit = np.roll(q, -1, -1) / np.maximum(np.linalg.norm(q, axis=-1, keepdims=True), 1e-9)
        unit = np.where(np.linalg.norm(unit, axis=-1, keepdims=True) > 0.5, unit, [0, 0, 0, 1.0])
        R = Rotation.from_quat(unit.reshape(-1, 4)).as_matrix().reshape(R.shape)
    return Motion(x[:, :a], x[:, a : a + n].reshape(m.p.shape), R, x[:, a + n :], m.valid)


class FaithfulHdmp:
    name = "hdmp-faithful"

    def reconstruct(self, of: Sample, cuts: list[int]) -> Motion:
        x, q = _columns(of.motion)
        y = np.concatenate([x, q.reshape(len(x), -1)], 1)
        at = peaks(y) if len(cuts) > 2 else cuts
        out = [y[:1]]
        for a, b in zip(at, at[1:], strict=False):
            out.append(self._primitive(y[a : b + 1], out[-1][-1])[1:])
        y = np.concatenate(out)
        return _motion(of.motion, y[:, : x.shape[1]], y[:, x.shape[1] :].reshape(q.shape))

    @staticmethod
    def _primitive(y: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Fit to y (T, n), then integrate from `start`. alpha_z 5, beta its quarter, phase a third; tau = T, dt = 1."""
        steps = len(y)
        alpha, tau = 5.0, float(len(y))
        beta, alpha_x = alpha / 4, alpha / 3
        t = np.arange(steps)
        x = np.exp(-alpha_x * t / tau)
        centre = np.linspace(0, steps, KERNELS)
        psi = np.exp(-0.5 * ((t[:, None] - centre) / (steps / KERNELS * 3.5 / 2)) ** 2)
        first = np.gradient(y, axis=0) if steps > 1 else y * 0
        second = np.gradient(first, axis=0) if steps > 1 else y * 0
        goal = y[-1]
        wanted = tau**2 * second - alpha * (beta * (goal - y) - tau * first)
        s = x[:, None] * (goal - y[0])
        top = np.einsum("tk,tn,tn->kn", psi, s, wanted)
        w = top / (np.einsum("tk,tn->kn", psi, s**2) + 1e-3)
        out, position, velocity = [start], start.copy(), first[0] * tau
        for k in range(steps - 1):
            forcing = (psi[k] @ w) / (psi[k].sum() + 1e-10) * x[k] * (goal - start)
            acceleration = (alpha * (beta * (goal - position) - velocity) + forcing) / tau
            velocity = velocity + acceleration
            position = position + velocity / tau
            out.append(position)
        return np.stack(out)


class Hdmp:
    name = "hdmp"

    @staticmethod
    def installed() -> bool:
        return packages.find("movement_primitives")

    def __init__(self):
        if not self.installed():
            raise UserError(f"hdmp needs the package movement-primitives: {packages.CURE}")

    def reconstruct(self, of: Sample, cuts: list[int]) -> Motion:
        from movement_primitives.dmp import DMP, CartesianDMP

        x, q = _columns(of.motion)
        at = peaks(np.concatenate([x, q.reshape(len(x), -1)], 1)) if len(cuts) > 2 else cuts
        got_x, got_q = x.copy(), q.copy()
        for a, b in zip(at, at[1:], strict=False):
            steps = b - a
            time = TICK * np.arange(steps + 1)
            # As many kernels as ticks fit to anything but the motion in between.
            kernels = min(KERNELS, max(1, steps // 2))
            dmp = DMP(x.shape[1], time[-1], TICK, n_weights_per_dim=kernels, smooth_scaling=True)
            dmp.imitate(time, x[a : b + 1])
            dmp.configure(start_y=got_x[a])
            got_x[a + 1 : b + 1] = dmp.open_loop()[1][1 : steps + 1]
            for k in range(q.shape[1]):
                pose = np.concatenate([np.zeros((steps + 1, 3)), q[a : b + 1, k]], 1)
                turn = CartesianDMP(time[-1], TICK, n_weights_per_dim=kernels, smooth_scaling=True)
                turn.imitate(time, pose)
                turn.configure(start_y=np.concatenate([np.zeros(3), got_q[a, k]]))
                got_q[a + 1 : b + 1, k] = turn.open_loop()[1][1 : steps + 1, 3:]
        return _motion(of.motion, got_x, got_q)
