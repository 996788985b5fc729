"""What the C++ side computes from readings (skills/state.h, kinematics/arm_model.h), once more in torch: a kinematic
rollout is trained through, so that it needs gradients. tests/python/test_kinematics.py holds the two together.

Rotations are matrices R (..., 3, 3); positions p (..., 3) in m.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

NEAR = 0.01  # m, kNear of skills/state.h


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """(..., 4) wxyz, any norm but 0 -> (..., 3, 3). Zeros (unused slots) give the identity."""
    q = np.asarray(quaternion, "f8")
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    q = np.where(norm > 0, q / np.maximum(norm, 1e-12), [1.0, 0.0, 0.0, 0.0])
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def quaternion(columns: Tensor) -> Tensor:
    """First two columns (..., 6) of rotations -> wxyz (..., 4), w >= 0: jumps at half turns. Zeros give zeros."""
    a, b = columns[..., :3], columns[..., 3:]
    c = torch.linalg.cross(a, b)
    xx, yy, zz = a[..., 0], b[..., 1], c[..., 2]
    squares = torch.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], -1)
    signs = torch.stack([torch.ones_like(xx), b[..., 2] - c[..., 1], c[..., 0] - a[..., 2], a[..., 1] - b[..., 0]], -1)
    q = 0.5 * squares.clamp(min=1e-8).sqrt() * torch.where(signs < 0, -1.0, 1.0)
    return q * (columns.abs().sum(-1, keepdim=True) > 0)


def cross_matrix(w: Tensor) -> Tensor:
    """(..., 3) -> (..., 3, 3), [w]x."""
    x, y, z = w.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))


def exp_so3(w: Tensor) -> Tensor:
    """Rodrigues' formula, smooth at 0. (..., 3) rad -> (..., 3, 3)."""
    square = (w * w).sum(-1)[..., None, None]
    angle = (square + 1e-12).sqrt()
    K = cross_matrix(w)
    one = torch.eye(3, dtype=w.dtype, device=w.device)
    return one + torch.sin(angle) / angle * K + (1 - torch.cos(angle)) / (square + 1e-12) * (K @ K)


def log_so3(R: np.ndarray) -> np.ndarray:
    """(..., 3, 3) -> (..., 3) rotation vectors, angle at most pi."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(*R.shape[:-2], 3)


def angle_between(A: Tensor, B: Tensor) -> Tensor:
    """Geodesic angle [rad] of two rotations, by the chord |A - B|_F = 2 sqrt(2) sin(angle / 2): exact, and with a
    gradient near 0 that the arc cosine of the trace does not have."""
    chord = ((A - B) ** 2).sum((-1, -2))
    return 2 * torch.asin((chord / 8 + 1e-12).sqrt().clamp(max=1 - 1e-6))


class Arm(torch.nn.Module):
    """Forward kinematics of the tip G in the base. arm: intabs._core.ArmModel."""

    def __init__(self, arm):
        super().__init__()
        frames = np.asarray(arm.frames)
        X = np.zeros((len(frames), 4, 4))
        X[:, :3, :3], X[:, :3, 3], X[:, 3, 3] = rotation(frames[:, 3:]), frames[:, :3], 1
        self.register_buffer("X", torch.tensor(X, dtype=torch.float32), persistent=False)

    def tip(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """q (..., 6) -> p_WG (..., 3), R_WG (..., 3, 3)."""
        c, s = torch.cos(q), torch.sin(q)
        o, one = torch.zeros_like(c), torch.ones_like(c)
        turn = torch.stack([c, -s, o, o, s, c, o, o, o, o, one, o, o, o, o, one], -1).unflatten(-1, (4, 4))
        link = self.X[:-1] @ turn  # all links at once: few large operations, not many small ones
        while link.shape[-3] > 1:
            n = link.shape[-3] // 2 * 2
            pairs = link[..., 0:n:2, :, :] @ link[..., 1:n:2, :, :]
            link = torch.cat([pairs, link[..., n:, :, :]], -3)
        X = link[..., 0, :, :] @ self.X[-1]
        return X[..., :3, 3], X[..., :3, :3]


def state_features(
    arm: Arm, q: Tensor, gripper: Tensor, p_WO: Tensor, R_WO: Tensor, known: Tensor, valid: Tensor
) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """AssembleState. q (..., 6), gripper (...) +-1, p_WO (..., 4, 3), R_WO (..., 4, 3, 3), known and valid (..., 4), 0
    or 1 -> s (..., 59), not normalised, and the tip (p_WG, R_WG)."""
    p_WG, R_WG = arm.tip(q)
    R_GW = R_WG.transpose(-1, -2)[..., None, :, :]
    p = (R_GW @ (p_WO - p_WG[..., None, :])[..., None])[..., 0]
    R = R_GW @ R_WO
    columns = torch.cat([R[..., 0], R[..., 1]], -1)
    objects = torch.cat([p, columns, valid[..., None], p / (NEAR + p.abs())], -1) * known[..., None]
    return torch.cat([q, gripper[..., None], objects.flatten(-2)], -1), (p_WG, R_WG)


def carried_motion(p_WG: Tensor, R_WG: Tensor, p_WG_next: Tensor, R_WG_next: Tensor, p_WO: Tensor) -> Tensor:
    """How objects (..., S, 3) would move in a tick if they were held by the tip: (..., S, 6) like ObjectMotion, in the
    tip's frame at its start. The rotation vector is first order: a tick turns by less than .1 rad."""
    R_GW = R_WG.transpose(-1, -2)
    turn = R_GW @ R_WG_next
    p_GO = (R_GW[..., None, :, :] @ (p_WO - p_WG[..., None, :])[..., None])[..., 0]
    step = (R_GW @ (p_WG_next - p_WG)[..., None])[..., 0]
    moved = step[..., None, :] + (turn[..., None, :, :] @ p_GO[..., None])[..., 0] - p_GO
    w = 0.5 * torch.stack(
        [
            turn[..., 2, 1] - turn[..., 1, 2],
            turn[..., 0, 2] - turn[..., 2, 0],
            turn[..., 1, 0] - turn[..., 0, 1],
        ],
        -1,
    )
    return torch.cat([moved, w[..., None, :].expand_as(moved)], -1)


def move_objects(p_WO: Tensor, R_WO: Tensor, R_WG: Tensor, motion: Tensor) -> tuple[Tensor, Tensor]:
    """The inverse of ObjectMotion: motion (..., 4, 6) in the tip's frame moves the poses on by one tick."""
    R = R_WG[..., None, :, :]
    p = p_WO + (R @ motion[..., :3, None])[..., 0]
    return p, exp_so3((R @ motion[..., 3:, None])[..., 0]) @ R_WO
