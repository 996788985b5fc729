"""Key points of a hand in a sequence of pictures and depths -> filtered points in W. The work is done in C++
(cpp/intabs/perception/hand.h)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from intabs import _core

STATES = _core.hand_states  # names by number; 1 measured and 2 filled are points one can use
NULL_POSE = (0, 0, 0, 1, 0, 0, 0)


@dataclass
class HandTrack:
    time: np.ndarray  # (T,) s
    points: np.ndarray  # (T, 21, 3) p_W [m], zero where nothing is known
    state: np.ndarray  # (T, 21) uint8, see STATES

    @property
    def valid(self) -> np.ndarray:
        """(T, 21) bool: measured or filled."""
        return (self.state == 1) | (self.state == 2)

    def counts(self) -> dict[str, int]:
        return {name: int((self.state == i).sum()) for i, name in enumerate(STATES)}


def track_hand(
    time: np.ndarray,
    uv: np.ndarray,
    depth: Iterable[np.ndarray | None],
    intrinsics: np.ndarray,
    X_WC: np.ndarray = NULL_POSE,
    distortion: Iterable[float] = (0, 0, 0, 0, 0),
    method: str = "robust",
    unit: float = 0.001,
    fixed_place: bool = True,
    bones: bool = True,
    jumps: bool = True,
    max_gap: float = 0.5,
) -> HandTrack:
    """time (T,) s, rising; uv (T, 21, 2) px, NaN where not seen; depth: for each frame an aligned (H, W) uint16 picture
    (`unit` m a count, 0: none), or the depths at the key points (21,) m, or None; it may be a generator, one picture is
    held at a time. intrinsics fx fy cx cy; X_WC (7,) or (T, 7). method: robust, or gaussian as in the thesis.

    ValueError, one line, for what does not fit.
    """
    uv = np.asarray(uv, "f8")
    points = np.zeros((len(uv), _number_of_points(uv), 3))
    state = np.zeros(points.shape[:2], np.uint8)
    distortion = [float(v) for v in distortion]
    count = 0
    for k, z in enumerate(depth):
        if k >= len(uv):
            raise ValueError(f"more depth pictures than frames ({len(uv)})")
        z = np.full(points.shape[1], np.nan) if z is None else np.asarray(z)
        points[k], state[k] = _core.lift_hand(uv[k], z, intrinsics, distortion, method, unit)
        count += 1
    if count != len(uv):
        raise ValueError(f"{count} depth pictures for {len(uv)} frames")
    points, state = _core.filter_hand(time, uv, points, state, X_WC, fixed_place, bones, jumps, max_gap)
    return HandTrack(np.asarray(time, "f8"), points, state)


def _number_of_points(uv: np.ndarray) -> int:
    if uv.ndim != 3 or uv.shape[1:] != (21, 2):
        raise ValueError(f"uv must be (T, 21, 2), not {uv.shape}")
    return uv.shape[1]
