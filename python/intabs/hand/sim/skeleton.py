"""A right hand of 21 key points with the bones of the table in cpp/intabs/perception/hand.h.

Frame H: origin in the wrist, x towards the fingers, y towards the thumb, z out of the back of the hand.
"""

from __future__ import annotations

import numpy as np

from intabs import _core

LENGTH = {(a, b): length for a, b, length in _core.hand_bones}
# Direction of index .. little finger in the palm [rad from x]; they span the palm's 66 mm.
SPREAD = (0.33, 0.09, -0.14, -0.39)
# Flexion of the joints [rad]: open, closed.
FLEXION = ((0.15, 1.00), (0.15, 1.15), (0.10, 0.75))

SKIN = 0.008  # m: a finger's half thickness
PALM = 0.012


def joints(closure: np.ndarray, scale: float) -> np.ndarray:
    """closure (T,) from 0 open to 1 closed -> (T, 21, 3) in H [m]."""
    c = np.asarray(closure, "f8")
    p = np.zeros((len(c), 21, 3))
    for finger, turn in enumerate(SPREAD):
        first = 5 + 4 * finger
        p[:, first] = LENGTH[0, first] * np.array([np.cos(turn), np.sin(turn), 0])
        bend = np.zeros(len(c))
        along = np.array([np.cos(0.5 * turn), np.sin(0.5 * turn), 0])
        for i, (opened, closed) in enumerate(FLEXION):
            bend = bend + opened + (closed - opened) * c
            step = np.cos(bend)[:, None] * along - np.sin(bend)[:, None] * np.array([0, 0, 1.0])
            p[:, first + i + 1] = p[:, first + i] + LENGTH[first + i, first + i + 1] * step
    # The thumb swings from beside the palm to before it.
    turn, down = 0.95 - 0.25 * c, 0.25 + 0.35 * c
    for i in range(4):
        step = np.stack([np.cos(down) * np.cos(turn), np.cos(down) * np.sin(turn), -np.sin(down)], axis=1)
        p[:, i + 1] = p[:, i] + LENGTH[i, i + 1] * step
        turn, down = turn - 0.30 - 0.10 * c, down + 0.12 * c
    return scale * p


def grip_point(closure: float, scale: float) -> np.ndarray:
    """Between the tips of thumb and index finger, in H."""
    p = joints(np.array([closure]), scale)[0]
    return 0.5 * (p[4] + p[8])


def flesh(p: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Spheres (S, 3), radii (S,) that fill one hand (21, 3) and its forearm."""
    centres, radii = [], []
    for (a, b), length in LENGTH.items():
        if (a, b) == (5, 17):
            continue
        palm = a == 0 and b != 1
        for s in np.linspace(0, 1, max(2, int(length / (0.009 if palm else 0.007)))):
            centres.append((1 - s) * p[a] + s * p[b])
            radii.append(PALM if palm else SKIN)
    for a, b in ((5, 9), (9, 13), (13, 17)):
        for s in (0.33, 0.67):
            for t in (0.4, 0.7, 1.0):
                centres.append(p[0] + t * ((1 - s) * p[a] + s * p[b] - p[0]))
                radii.append(PALM)
    back = p[0] - p[9]
    back /= np.linalg.norm(back)
    for s in np.linspace(0.02, 0.2, 7):
        centres.append(p[0] + s * back)
        radii.append(0.026)
    return np.array(centres), scale * np.array(radii)
